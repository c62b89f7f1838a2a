"""How soon after the producer's last write can the consumer process read all bytes, and when has it read them?

Rule: one definition holds for all variants, which run in interleaved rounds. The producer writes the bytes of each
frame, and reads the clock after the last byte. Two variants are compared with the peers. The first is a real run
through the scheduler, of a pipeline with four stages in a chain. Its second stage fills a slot, and its third stage
reads every byte of the slot; the others do no work. The second variant has the same slot, but no scheduler between the
processes.
"""

from __future__ import annotations

import multiprocessing
import os
import signal
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from multiprocessing.connection import Connection
from multiprocessing.context import SpawnContext
from statistics import median
from typing import Any

import numpy as np

from trilane.arrays import U8
from trilane.bench.lib.handoff_variants import BARE, CHANNELS, SLOT, WRITTEN, Channel
from trilane.errors import BadInputError, TrilaneError, install_line
from trilane.hw_profiles.host import host_units
from trilane.machine import UNIT_SLICE_NS, awake, use_slice
from trilane.pipeline.description import Pipeline, PipelineEdge, PipelineStage
from trilane.pipeline.run import run_pipeline
from trilane.pipeline.stage import UnitContext
from trilane.scheduler.stats import median_interval, samples_needed
from trilane.transport.packets import Packet

#: Accepted sizes in KiB: tensors of 16 channels at 128, 256, 512 and 1024 pixels a side.
SIZES_KIB = (256, 1024, 4096, 16384)
PIPELINE = "slot through the scheduler"
OURS = (SLOT, BARE, PIPELINE)
MIN_FRAMES = 10
ANSWER_S = 120
LIMITS_US = {"p50": 150, "p99": 500}
ENDS = ("producer", "consumer")
#: Times of the frames of a round, microseconds: until every byte could be read, and until every byte was read.
Times = tuple[list[float], list[float]]
FACTORY = "trilane.bench.handoff:build"
PAUSE_S = 0.001
WRITER, READER = "raster", "infer"
STAGES = (("pose", "cpu"), (WRITER, "gpu"), (READER, "dsp"), ("present", "cpu"))


def measure(kib: tuple[int, ...] = (256, 4096, 16384), frames: int = 300, rounds: int = 6) -> dict[str, Any]:
    """Measure how long a hand-over takes from the last byte written, by variant and size.

    `kib`: sizes in KiB: 256, 1024, 4096 or 16384.
    `frames`: number of hand-overs of each variant and size in a round.
    `rounds`: number of rounds, in which all variants take part.

    `rows` has a row for each variant (`way`) and size (`kib`).
    `frames`: number of hand-overs in all rounds.
    `p50_us`, `p99_us`: percentiles of the time until every byte can be read.
    `read_p50_us`, `read_p99_us`: percentiles of the time until every byte was read and checked.
    `max_us`: longest time until every byte can be read.
    Each percentile is the median of the rounds' percentiles. The keys with `_low_us` and `_high_us` have the 95 %
    interval of this median; with fewer than six rounds, the least and the largest percentile. With fewer than 299
    frames in a round, the p99 is null. Before each hand-over, the consumer waits at least 1 ms, as an idle unit does.

    Trilane has three variants.
    `slot through the scheduler`: as in a run, the message goes to the scheduler's process, through the scheduler's
    core, and on to the next unit.
    `slot`: the message goes directly from process to process.
    `slot, 256 KiB of it written`: the same, but most of the slot is not written, so the caches hardly change.

    The peers are in their best form, and have no scheduler.
    `iceoryx2`: a sample is written in place, and an event wakes the consumer.
    `zeromq`: the bytes are a ZeroMQ frame, which pyzmq itself does not copy.
    `pipe`: the bytes go through multiprocessing.Pipe into an array.
    `pickled queue`: the array goes through multiprocessing.Queue.

    `absent`: reason for each peer that is not installed.
    `met`: whether p50 <= 150 us and p99 <= 500 us at the largest size, for `slot` and `slot through the scheduler`;
    null without a p99.
    `p50_largest_over_smallest`: p50 at the largest size divided by p50 at the smallest, by variant of Trilane.
    `slower_us`: p50 of the peer minus p50 of `slot through the scheduler` in the same round. The value is the 95 %
    interval of the median over the rounds, by peer and size.
    `read_slower_us`: the same for the times until every byte was read.
    `slower_than_slot_us`, `read_slower_than_slot_us`: the same, with `slot` in place of `slot through the scheduler`.
    `ahead`, `read_ahead`: whether the peer is slower than `slot through the scheduler` at every size, by peer. All
    intervals of the peer must lie above 0.

    Raises BadInputError for other sizes, fewer than 10 frames or no round, TrilaneError if a process or a run fails.
    """
    if unknown := set(kib) - set(SIZES_KIB):
        raise BadInputError("--kib", str(min(unknown)), ", ".join(map(str, SIZES_KIB)))
    if frames < MIN_FRAMES:
        raise BadInputError("--frames", str(frames), f"at least {MIN_FRAMES}")
    if rounds < 1:
        raise BadInputError("--rounds", str(rounds), "at least 1")
    times: dict[tuple[str, int], list[Times]] = {}
    with awake() as idle_cores, ExitStack() as stack:
        pairs, absent = _pairs(stack, kib)
        for number in range(rounds):
            for size in kib:
                variants = [variant for variant, of in pairs if of == size]
                # Each round begins with another variant, so that none is always the first.
                first = number % len(variants)
                for variant in variants[first:] + variants[:first]:
                    times.setdefault((variant, size), []).append(pairs[variant, size].run(frames))
                times.setdefault((PIPELINE, size), []).append(_through_pipeline(size, frames))
    config = {"frames": frames, "rounds": rounds, "idle_cores": idle_cores}
    by_size = sorted(times.items(), key=lambda item: item[0][1])
    rows = [_row(variant, size, rounds) for (variant, size), rounds in by_size]
    verdicts = {**_verdicts(rows, max(kib)), **against_peers(times)}
    return {"rows": rows, **verdicts, "absent": absent, "config": config}


class ChannelPair:
    """A producer process and a consumer process that a channel connects. Both wait until `run` requests hand-overs.

    `context`: context of multiprocessing that starts the processes. `channel`: channel between them. `written`: number
    of bytes that are written and read in each hand-over.
    The constructor raises TrilaneError if a process cannot start.
    """

    def __init__(self, context: SpawnContext, channel: Channel, written: int) -> None:
        self._channel = channel
        ours, theirs = zip(*(context.Pipe() for _ in ENDS), strict=True)
        between = context.Pipe()
        self._pipes: Sequence[Connection] = ours
        units = host_units()
        cores = (units["gpu"].cores, units["dsp"].cores)
        self._processes = [
            context.Process(target=end, args=(pipe, ack, channel, own, written), daemon=True)
            for end, pipe, ack, own in zip((produce, consume), theirs, between, cores, strict=True)
        ]
        for process in self._processes:
            process.start()
        for pipe in (*theirs, *between):
            pipe.close()
        try:
            for pipe in self._pipes:
                _answer(pipe)
        except BaseException:
            self.close()
            raise

    def run(self, frames: int) -> Times:
        """Do `frames` hand-overs, and return (times until all bytes can be read, times until all were read), in µs.

        The times begin when all bytes were written. Raises TrilaneError if a process fails.
        """
        for pipe in reversed(self._pipes):
            pipe.send(frames)
        written, (readable, read) = (_answer(pipe) for pipe in self._pipes)
        return _microseconds(readable, written), _microseconds(read, written)

    def close(self) -> None:
        """End both processes, and release the channel."""
        for pipe in self._pipes:
            pipe.close()
        for process in self._processes:
            process.join(2)
            process.kill()
            process.join()
        self._channel.close()


def produce(pipe: Connection, ack: Connection, channel: Channel, cores: tuple[int, ...], written: int) -> None:
    """Run the process that writes.

    For each number of frames that the process receives, it does as many hand-overs. The answer is a list of the times
    in ns at which the last byte of each frame was written.
    `pipe`: pipe to the parent process. `ack`: pipe on which the other process acknowledges each frame. `channel`:
    channel between both processes. `cores`: cores of the process. `written`: number of bytes in each hand-over.
    """
    with _child(pipe, cores):
        end = channel.producer()
        pipe.send("ready")
        while True:
            instants = []
            for frame in range(pipe.recv()):
                time.sleep(PAUSE_S)
                end.buffer()[:written] = frame % 251
                instants.append(time.monotonic_ns())
                end.hand_over()
                ack.recv_bytes()
            pipe.send(instants)


def consume(pipe: Connection, ack: Connection, channel: Channel, cores: tuple[int, ...], written: int) -> None:
    """Run the process that reads.

    For each number of frames that the process receives, it takes as many hand-overs. The answer is two lists of times
    in ns: when all bytes of each frame could be read, and when all of them were read. Parameters: see `produce`.
    """
    with _child(pipe, cores):
        end = channel.consumer()
        pipe.send("ready")
        while True:
            readable, read = [], []
            for frame in range(pipe.recv()):
                payload = end.receive()
                readable.append(time.monotonic_ns())
                check_bytes(payload[:written], frame % 251)
                read.append(time.monotonic_ns())
                del payload
                end.release()
                ack.send_bytes(b"\0")
            pipe.send((readable, read))


@contextmanager
def _child(pipe: Connection, cores: tuple[int, ...]) -> Iterator[None]:
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent ends it
    os.sched_setaffinity(0, cores)
    # The kernel schedules the processes of units with the same slice.
    use_slice(UNIT_SLICE_NS)
    try:
        yield
    except (EOFError, BrokenPipeError, ConnectionResetError):
        return
    except Exception as error:
        pipe.send(TrilaneError(f"{type(error).__name__}: {error}"))


def _answer(pipe: Connection) -> Any:
    if not pipe.poll(ANSWER_S):
        raise TrilaneError(f"bench handoff: no answer in {ANSWER_S} s")
    answer = pipe.recv()
    if isinstance(answer, TrilaneError):
        raise answer
    return answer


def _pairs(stack: ExitStack, sizes: tuple[int, ...]) -> tuple[dict[tuple[str, int], ChannelPair], dict[str, str]]:
    """Return (processes by variant and size in KiB, reason for each absent variant). `stack` ends the processes."""
    context = multiprocessing.get_context("spawn")
    pairs, absent = {}, {}
    for variant, make in CHANNELS.items():
        for size in sizes:
            try:
                channel = make(size * 1024, context)
            except ModuleNotFoundError as error:
                absent[variant] = f"{error.name} is not installed: {install_line('peers')}"
                break
            pairs[variant, size] = ChannelPair(context, channel, WRITTEN.get(variant, size * 1024))
            stack.callback(pairs[variant, size].close)
    return pairs, absent


def _through_pipeline(size: int, frames: int) -> Times:
    """Run `handoff_pipeline` with slots of `size` KiB. Raises TrilaneError if it does not present all `frames`.

    Return (times from raster's end to infer's begin, times from raster's end to infer's end), in µs.
    """
    result = run_pipeline(handoff_pipeline(size * 1024), frames, policy="sequential")
    if result.interrupted:
        raise KeyboardInterrupt
    if result.failure is not None or result.presented < frames:
        raise TrilaneError(f"the run with {size} KiB failed: {result.failure or 'frames were lost'}")
    jobs = [job for job in result.jobs if job.stage == READER]
    readable = _microseconds([job.begin_ns for job in jobs], [job.ready_ns for job in jobs])
    return readable, _microseconds([job.end_ns for job in jobs], [job.ready_ns for job in jobs])


def _microseconds(ends_ns: Sequence[int], begins_ns: Sequence[int]) -> list[float]:
    return [(end - begin) / 1e3 for end, begin in zip(ends_ns, begins_ns, strict=True)]


def _row(variant: str, size: int, rounds: list[Times]) -> dict[str, Any]:
    readable, read = zip(*rounds, strict=True)
    return {
        "way": variant,
        "kib": size,
        "frames": sum(map(len, readable)),
        **over_rounds("p50", readable, 50),
        **over_rounds("p99", readable, 99),
        "max_us": max(map(max, readable)),
        **over_rounds("read_p50", read, 50),
        **over_rounds("read_p99", read, 99),
    }


def over_rounds(key: str, rounds: Sequence[list[float]], percent: float) -> dict[str, float | None]:
    """Return the median of the rounds' percentiles and its 95 % interval; all None if a round has too few values.

    `key`: beginning of the result's keys, which end in `_us`, `_low_us` and `_high_us`. `rounds`: times of each round,
    in µs. `percent`: percentile, 0 to 100.
    """
    names = (f"{key}_us", f"{key}_low_us", f"{key}_high_us")
    if min(map(len, rounds)) < samples_needed(percent / 100):
        return dict.fromkeys(names)
    of_each = [float(np.percentile(values, percent)) for values in rounds]
    return dict(zip(names, (median(of_each), *median_interval(of_each)), strict=True))


def _verdicts(rows: list[dict[str, Any]], largest: int) -> dict[str, Any]:
    p50 = {(row["way"], row["kib"]): row["p50_us"] for row in rows}
    ours = [row for row in rows if row["way"] in (SLOT, PIPELINE) and row["kib"] == largest]
    sizes = sorted({size for _, size in p50})
    return {
        "met": {row["way"]: _met(row) for row in ours},
        "p50_largest_over_smallest": {variant: p50[variant, sizes[-1]] / p50[variant, sizes[0]] for variant in OURS},
    }


def _met(row: dict[str, Any]) -> bool | None:
    values = {key: row[f"{key}_us"] for key in LIMITS_US}
    if None in values.values():
        return None
    return all(values[key] <= limit for key, limit in LIMITS_US.items())


def against_peers(times: dict[tuple[str, int], list[Times]]) -> dict[str, Any]:
    """Return how much longer each peer takes than Trilane's variants, under the keys that `measure` describes.

    `times`: times of each round, by variant and size in KiB.
    """
    slower, read_slower = _slower(times, PIPELINE, 0), _slower(times, PIPELINE, 1)
    return {
        "ahead": _ahead(slower),
        "read_ahead": _ahead(read_slower),
        "slower_us": slower,
        "read_slower_us": read_slower,
        "slower_than_slot_us": _slower(times, SLOT, 0),
        "read_slower_than_slot_us": _slower(times, SLOT, 1),
    }


def _slower(
    times: dict[tuple[str, int], list[Times]], ours: str, until: int
) -> dict[str, dict[int, tuple[float, float]]]:
    """Return how much longer each peer takes than the variant `ours`, in µs, by peer, by size in KiB.

    A round's value is the p50 of the peer minus the p50 of `ours`. The result has the 95 % interval (low, high) of the
    median over the rounds.
    `until`: index into `Times`: 0 until all bytes can be read, 1 until all were read.
    """
    p50 = {key: np.array([np.percentile(of_round[until], 50) for of_round in of]) for key, of in times.items()}
    sizes = sorted({size for _, size in times})
    peers = sorted({variant for variant, _ in times} - {*OURS})
    return {
        peer: {size: median_interval((p50[peer, size] - p50[ours, size]).tolist()) for size in sizes} for peer in peers
    }


def _ahead(slower: dict[str, dict[int, tuple[float, float]]]) -> dict[str, bool]:
    return {peer: all(low > 0 for low, _ in of_size.values()) for peer, of_size in slower.items()}


class HandoffStage:
    """A stage of `handoff_pipeline`. Its name decides whether it pauses, writes, reads or does nothing."""

    def __init__(self, name: str) -> None:
        self._name = name

    def bind(self, inputs: Sequence[Packet], outputs: Sequence[Packet]) -> None:
        """Keep the slots that the stage reads and writes."""
        self._inputs, self._outputs = inputs, outputs

    def run(self, frame: int, slot_in: int | None, slot_out: int | None) -> Mapping[str, float]:
        """Run a job: `pose` pauses, `raster` writes, `infer` reads. Raises TrilaneError if `infer` reads wrong bytes.

        `frame`: number of the frame. `slot_in`, `slot_out`: numbers of the slots to read and to write; None for none.
        """
        if self._name == STAGES[0][0]:
            time.sleep(PAUSE_S)
        elif self._name == WRITER and slot_out is not None:
            self._outputs[slot_out].payload[:] = frame % 251
        elif self._name == READER and slot_in is not None:
            check_bytes(self._inputs[slot_in].payload, frame % 251)
        return {}

    def close(self) -> None:
        """Do nothing: there is nothing to release."""


def check_bytes(payload: U8, value: int) -> None:
    """Raise TrilaneError if the bytes of `payload` are not all `value`.

    Only the sum of the 64-bit words is compared, modulo 2^64. `payload`: bytes to check, a multiple of 8.
    """
    words = payload.view(np.uint64)
    if int(words.sum(dtype=np.uint64)) != len(words) * value * 0x0101010101010101 % 2**64:
        raise TrilaneError(f"a slot of {payload.size} bytes holds others than were written")


def build(settings: Mapping[str, Any], unit: UnitContext) -> HandoffStage:  # noqa: ARG001 - a factory's signature
    """Return the stage with the name `settings["name"]`. This function is the factory of all stages."""
    return HandoffStage(settings["name"])


def handoff_pipeline(payload_bytes: int) -> Pipeline:
    """Return a pipeline of four stages in a chain. Only the edge from raster to infer has a payload.

    `payload_bytes`: size of this payload.
    """
    sizes = [payload_bytes if before == WRITER else 0 for before, _ in STAGES[:-1]]
    stages = (PipelineStage(name=name, unit=unit, factory=FACTORY, settings={"name": name}) for name, unit in STAGES)
    return Pipeline(
        stages=tuple(stages),
        edges=tuple(PipelineEdge(payload_bytes=size) for size in sizes),
        units=host_units(),
    )
