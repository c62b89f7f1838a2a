"""Predicts a pipeline file on a chip: a time for each stage, then a run of the scheduler in virtual time.

The time of a stage comes from the file, else from a measurement on this machine, else from its network and the hardware
of its unit. There are two kinds of uncertainty. Jitter differs from frame to frame, and is part of the simulated run.
Ignorance is the error of the chip's model, or of measured times; it is the same for all frames, and gives the
intervals. Each interval contains the true value with a probability of 80 %.

Rule: all random numbers follow from the seed, the stage's name and the frame. Therefore two variants of a file get the
same random numbers.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Final, Literal, NamedTuple
from zlib import crc32

import numpy as np
from numpy.typing import NDArray
from pydantic import ValidationError

from trilane.errors import BadInputError
from trilane.hw_profiles.graph_file import GraphFile
from trilane.hw_profiles.host_model import MODEL_ERROR, UNMEASURED, is_known
from trilane.hw_profiles.network_time import interval, price
from trilane.hw_profiles.rates import FrameInterval, holding, wanted_drops
from trilane.hw_profiles.schema import Corners, Profile, interval_around
from trilane.pipeline.file_graph import (
    edge_rules,
    graph_of,
    in_flight_of,
    settings_of,
    shares_of,
    skips_of,
    source_ns,
)
from trilane.pipeline.file_keys import LONGEST_MS, OnnxStage, StageTime
from trilane.pipeline.pipeline_file import PipelineFile
from trilane.scheduler.events import Graph, Settings, Stop
from trilane.scheduler.period_bound import PeriodBound, period_bound
from trilane.scheduler.virtual import Simulation, simulate
from trilane.transport.slots import edge_rule
from trilane.units import HOST, NS_PER_MS, UNITS, UnitName

#: Approximate number of frames that the runs at the ends of the interval present.
SIMULATED_FRAMES: Final = 1000
#: Approximate number of frames of a run whose source is always ready.
FED_FRAMES: Final = 2000
#: Most frames of such a run. A first stage that takes no time is never delayed if only `latest` inputs read it.
MOST_FED: Final = 2 * FED_FRAMES
EVEN: Final = (840, 60)  # least common multiples of the numbers up to 8, and up to 6
BLOCK: Final = 4096  # number of frames whose times are drawn at once
#: In virtual time no job hangs, however long it takes.
NEVER_HANGS_NS: Final = 1 << 60
#: Which time of a stage is used: the expected time, or an end of its 80 % interval.
Ends = Literal["expected", "low", "high"]
ENDS: Final[tuple[Ends, ...]] = ("expected", "low", "high")

#: (name of a stage, its graph, its unit of hardware) -> the chip in the precision and under the runtime of the network.
ChipFor = Callable[[str, GraphFile, UnitName], Profile]


@dataclass(frozen=True)
class StagePrice:
    """The time of a job of a stage.

    `source`: source of the time, in words.
    `low_ms`, `high_ms`: 80 % interval of the mean. For a time that the file states, both are the mean. None if the
    error is not known.
    `why`: reasons for the interval's width, or for its absence.
    `is_modelled`: whether the time follows only from the network and the chip.
    `is_measured`: whether the time comes from a run on this machine.
    """

    time: StageTime
    source: str
    low_ms: float | None = None
    high_ms: float | None = None
    why: tuple[str, ...] = ()
    is_modelled: bool = False
    is_measured: bool = False

    @property
    def mean_ns(self) -> int:
        return round(self.time.mean_ms * NS_PER_MS)


def given_price(file: PipelineFile, name: str) -> StagePrice | None:
    """Return the time that the file states for the stage `name`; None if the file states none."""
    stage = file.stages[name]
    time = stage.own_time
    if time is None:
        return None
    source = "time_ms" if stage.time_ms else f"block {stage.named_kind}"
    return StagePrice(time, source, low_ms=time.mean_ms, high_ms=time.mean_ms)


def network_price(chip: Profile, graph: GraphFile, unit: UnitName, corners: Corners) -> StagePrice:
    """Return the time of a network on `unit` of `chip`, which computes in the network's precision."""
    time = price(chip, graph.work, unit, corners)
    around = interval(chip, graph.work, time)
    source = f"{chip.name}, {unit} in {chip.units[unit].precision}"
    mean = StageTime(mean=time.total_ms)
    if not is_known(chip, unit):
        return StagePrice(mean, source, why=(UNMEASURED,), is_modelled=True)
    return StagePrice(mean, source, around.low_ms, around.high_ms, around.why, is_modelled=True)


class MeasuredStages(NamedTuple):
    """Times of stages that a run of the file on this machine measured.

    `times`: time of a job by the stage's name.
    `run`: folder of the run.
    `chip`: name of the predicted chip, HOST for this machine; "" if the command takes no measured run.
    """

    times: Mapping[str, StageTime]
    run: str
    chip: str


NOTHING_MEASURED: Final = MeasuredStages({}, "", "")


def measured_price(file: PipelineFile, name: str, measured: MeasuredStages) -> StagePrice | None:
    """Return the time of the stage `name` from a run on this machine; None if the stage was not measured.

    For another chip, the stage's key `scale` multiplies the time; without this key, the result is None.

    Raises BadInputError for a `scale` that makes a time too long.
    """
    factor = 1.0 if measured.chip == HOST else file.stages[name].scale.get(measured.chip)
    if name not in measured.times or factor is None:
        return None
    try:
        time = measured.times[name].times(factor)
    except ValidationError:
        found = f"a factor of {factor:g} for times around {measured.times[name].mean_ms:g} ms"
        where = f"{file.path}: stages.{name}.scale.{measured.chip}"
        raise BadInputError(where, found, f"no time above {LONGEST_MS:g} ms in the result") from None
    source = f"measured in {measured.run}" + (f", times {factor:g}" if measured.chip != HOST else "")
    return StagePrice(time, source, *interval_around(time.mean_ms, MODEL_ERROR), is_measured=True)


def stages_without_time(file: PipelineFile, measured: MeasuredStages = NOTHING_MEASURED) -> list[str]:
    """Return the names of the stages without a known time: no network, no measured time, and none in the file."""
    return [
        name
        for name, stage in file.stages.items()
        if not isinstance(stage, OnnxStage)
        and given_price(file, name) is None
        and measured_price(file, name, measured) is None
    ]


def prices_of(
    file: PipelineFile,
    graphs: Mapping[str, GraphFile],
    chip_for: ChipFor,
    corners_of_chip: Callable[[Profile], Corners],
    measured: MeasuredStages = NOTHING_MEASURED,
) -> dict[str, StagePrice]:
    """Return the time of every stage: the first known one of key `time_ms`, a measured run, the block, the network.

    `graphs`: graphs of the networks, by the stage's name.
    `chip_for`: function that returns the chip in the precision of a network.
    `corners_of_chip`: function that returns the corners of a chip's units.

    Raises BadInputError naming the stages without a time.
    """
    if unknown := stages_without_time(file, measured):
        raise _without_a_time(file, unknown, measured)
    found = {}
    for name, stage in file.stages.items():
        known = None if stage.time_ms is None else given_price(file, name)
        known = known or measured_price(file, name, measured) or given_price(file, name)
        if known is None and isinstance(stage, OnnxStage):
            unit = next(each for each in UNITS if each == file.hardware(stage.unit))
            chip = chip_for(name, graphs[name], unit)
            known = network_price(chip, graphs[name], unit, corners_of_chip(chip))
        assert known is not None
        found[name] = known
    return found


def _without_a_time(file: PipelineFile, names: Sequence[str], measured: MeasuredStages) -> BadInputError:
    """Return the error for the stages `names`, which have no time. Its place is the first; its text names the rest."""
    first = names[0]
    found = f"{file.stages[first].named_kind} without a time"
    if names[1:]:
        found += f" (others without one: {', '.join(names[1:])})"
    remedy = "add time_ms = MS to each"
    if measured.chip:
        remedy += f", or all in one --set {','.join(f'stages.{name}.time_ms=MS' for name in names)}"
    remedy += '; time_ms = { from = "FILE" } takes what `trilane times` reads'
    if first in measured.times:
        remedy += f"; or scale = {{ {measured.chip} = ... }} for its measured time"
    elif measured.chip and not measured.times:
        remedy += "; or take the times of a run on this machine: --measured RUN"
        remedy += "" if measured.chip == HOST else f" and scale = {{ {measured.chip} = ... }} in each"
    expected = "a stage whose time is known" + (f" on {measured.chip}" if measured.chip else "")
    return BadInputError(f"{file.path}: stages.{first}", found, expected, remedy)


def factors_at(prices: Mapping[str, StagePrice], end: Ends) -> dict[str, float]:
    """Return, by stage, its time at `end` of its interval, divided by its expected time."""
    found = {}
    for name, each in prices.items():
        at = {"expected": None, "low": each.low_ms, "high": each.high_ms}[end]
        found[name] = 1.0 if at is None or not each.time.mean_ms else at / each.time.mean_ms
    return found


def bound_of(file: PipelineFile, prices: Mapping[str, StagePrice]) -> tuple[Graph, PeriodBound]:
    """Return (scheduler's graph of `file`, lower bound on its period, from the mean times of its stages)."""
    times = {name: each.mean_ns for name, each in prices.items()}
    graph = graph_of(file, edge_rules(file))
    return graph, period_bound(graph, times, in_flight_of(file), source_ns(file), shares_of(file))


class Drawn:
    """A function for the virtual clock that returns the time of each job in ns.

    `prices`: time of each stage, by name. `seed`: seed of the random numbers.
    `factors`: factor on the time of each stage, by name; 1 for a stage that is not listed.
    """

    def __init__(self, prices: Mapping[str, StagePrice], seed: int, factors: Mapping[str, float] | None = None) -> None:
        self._prices, self._seed, self._factors = prices, seed, factors or {}
        self._fixed = {
            name: round(each.mean_ns * self._factors.get(name, 1.0))
            for name, each in prices.items()
            if not each.time.varies
        }
        self._blocks: dict[str, tuple[int, list[int]]] = {}

    def __call__(self, stage: str, _unit: str, frame: int, _begin_ns: int) -> int:
        fixed = self._fixed.get(stage)
        if fixed is not None:
            return fixed
        number, place = divmod(frame, BLOCK)
        block = self._blocks.get(stage)
        if block is None or block[0] != number:
            rng = np.random.default_rng([self._seed, crc32(stage.encode()), number])
            times = _draw_ms(self._prices[stage].time, rng) * self._factors.get(stage, 1.0) * NS_PER_MS
            block = self._blocks[stage] = number, np.rint(times).astype(np.int64).tolist()
        return block[1][place]


def _draw_ms(time: StageTime, rng: np.random.Generator) -> NDArray[np.float64]:
    """Return random times of a block of frames in ms (BLOCK,)."""
    if time.samples:
        return rng.choice(np.array(time.samples), BLOCK)
    if time.exponential is not None:
        return rng.exponential(time.exponential, BLOCK)
    variance = math.log1p((time.sd / time.mean_ms) ** 2)
    return rng.lognormal(math.log(time.mean_ms) - variance / 2, math.sqrt(variance), BLOCK)


def predict_file(
    file: PipelineFile, prices: Mapping[str, StagePrice], frames: int = 0, seed: int = 0
) -> dict[str, Any]:
    """Return the prediction of `file`, with the keys of report.json.

    `prices`: time of each stage, by name.
    `frames`: number of frames of the simulated run; 0: the file's number, or 1000 if it has none.
    `seed`: seed of all random numbers.
    """
    graph, bound = bound_of(file, prices)
    settings = settings_of(file, frames, seed, hang_ns=NEVER_HANGS_NS)
    report = simulate(graph, settings, Drawn(prices, seed), skips=skips_of(file, seed)).report
    needs = _needs(file, prices, seed)
    frame_time, latency = _intervals(file, prices, graph, report, needs, seed)
    answer = {
        "name": file.path.stem,
        "source": str(file.path),
        "period_ms": float(bound.period_ns) / NS_PER_MS,
        "cycle": list(bound.stages),
        "limit": bound.limit,
        "needs_ms": {"mean": needs.ms, "low": needs.low_ms, "high": needs.high_ms},
        **report,
        "frame_time_ms": {**report["frame_time_ms"], **frame_time},
        "latency_ms": {**report["latency_ms"], **latency},
        "stages": {name: {**row, **_row(prices[name])} for name, row in report["stages"].items()},
        "slots": dict(zip(graph.streams, graph.edges, strict=True)),
    }
    if file.run.fps is not None:
        counts = report["frames"]
        drops = wanted_drops(counts["dropped"])
        rate = holding(file.run.fps, needs, drops, report["deadline_misses"], counts["requested"])
        share = "" if needs.low_ms is None else _share(file)
        answer["rate"] = {**rate.as_json(), "sentence": rate.sentence + share}
    return answer


def _share(file: PipelineFile) -> str:
    """Return a sentence about the share of presented frames if the key `every` leaves some out; otherwise ""."""
    period = file.periods[file.latency_to]
    return f"; {file.latency_to} has one frame of {period}, by every" if period > 1 else ""


def _row(stage: StagePrice) -> dict[str, Any]:
    return {
        "alone_ms": stage.time.mean_ms,
        "low_ms": stage.low_ms,
        "high_ms": stage.high_ms,
        "source": stage.source,
        "why": list(stage.why),
    }


def _needs(file: PipelineFile, prices: Mapping[str, StagePrice], seed: int) -> FrameInterval:
    """Return the frame time, with its interval, if the source is always ready.

    The interval is unknown if the error of a stage is unknown. `seed`: seed of the simulated runs.
    """
    (graph, settings), skips = always_fed(file), skips_of(file, seed)

    def needs_ms(end: Ends) -> float:
        factors = factors_at(prices, end)
        bound_ms = fed_bound_ms(file, {name: each.time.mean_ms * factors[name] for name, each in prices.items()})
        stop_ns = round(FED_FRAMES * bound_ms * NS_PER_MS)
        stop = ((stop_ns, Stop()),)
        run = simulate(graph, settings, Drawn(prices, seed, factors), skips=skips, inputs=stop)
        return max(bound_ms, steady_ms(run, stop_ns, repeats_after(file)))

    if any(each.low_ms is None for each in prices.values()):
        return FrameInterval(needs_ms("expected"))
    return over_ends(needs_ms, _is_unsure(prices))


def _is_unsure(prices: Mapping[str, StagePrice]) -> bool:
    return any(each.low_ms != each.high_ms for each in prices.values())


def always_fed(file: PipelineFile) -> tuple[Graph, Settings]:
    """Return (graph, settings) of a file for a run whose source is always ready and in which no frame is dropped."""
    graph = holding_back(replace(graph_of(file, edge_rules(file)), from_release=False))
    return graph, Settings(MOST_FED, hang_ns=NEVER_HANGS_NS, in_flight=in_flight_of(file))


def holding_back(graph: Graph) -> Graph:
    """Return the graph with edges that delay their writers and never drop a frame.

    A rate is judged with these edges, because it holds only if every frame is presented.
    """
    rules = ((rule, edge_rule(rule)) for rule in graph.edges)
    edges = (f"fifo:{known.slots}" if known.yields else rule for rule, known in rules)
    return replace(graph, edges=tuple(edges))


def fed_bound_ms(file: PipelineFile, times_ms: Mapping[str, float]) -> float:
    """Return the lower bound on the frame time in ms if the source is always ready.

    `times_ms`: time of a job of each stage.
    """
    (graph, settings), times = always_fed(file), {name: round(ms * NS_PER_MS) for name, ms in times_ms.items()}
    return float(period_bound(graph, times, settings.in_flight, shares=shares_of(file)).period_ns) / NS_PER_MS


def repeats_after(file: PipelineFile) -> int:
    """Return after how many frames the keys `every` and the pattern of the bypass select the same stages again."""
    return math.lcm(*file.periods.values(), len(file.bypass[1].pattern or ".") if file.bypass else 1)


def steady_ms(run: Simulation, stop_ns: int, repeats: int) -> float:
    """Return the mean frame time in ms, in the second half of a run whose source is always ready until `stop_ns`.

    The first half does not count, because slots may fill for hundreds of frames. The time after `stop_ns` does not
    count, because the pipeline runs empty. The order of the jobs repeats after a multiple of `repeats`, because slots
    fill in turn. Therefore the number of frames that count is a multiple of 840 * `repeats` (`EVEN`); in a shorter
    run, of 60 * `repeats` or `repeats`. If fewer than two frames are presented there, the result is the whole time.

    `repeats`: result of `repeats_after`.
    """
    shown = {frame: ns for frame, ns in run.shown_ns.items() if ns <= stop_ns}
    last = max(shown, default=0)
    half = last // 2
    count = next((half // whole * whole for each in (*EVEN, 1) if (whole := each * repeats) <= half), half)
    first = next((frame for frame in range(last - count, last) if frame in shown), None)
    return (stop_ns if first is None else (shown[last] - shown[first]) / (last - first)) / NS_PER_MS


def over_ends(ms_at: Callable[[Ends], float], is_unsure: bool = True) -> FrameInterval:
    """Return a time with its interval.

    The ends of the interval are the times that result if all stages have the low ends, or the high ends, of their
    intervals. The errors of all stages count as one error, because they come from one model of one chip, or from one
    run.

    `ms_at`: function that returns the time in ms at an end.
    `is_unsure`: whether the ends differ from the expected time.
    """
    found = [*map(ms_at, ENDS if is_unsure else ENDS[:1])]
    return FrameInterval(found[0], min(found), max(found))  # jobs interleave differently, so the ends may cross


def _intervals(
    file: PipelineFile,
    prices: Mapping[str, StagePrice],
    graph: Graph,
    report: Mapping[str, Any],
    needs: FrameInterval,
    seed: int,
) -> tuple[dict[str, float | None], dict[str, float | None]]:
    """Return (interval of the mean frame time, interval of the mean latency), from short simulated runs at both ends.

    If no frame is dropped, the interval of the frame time comes from `needs` and the period of the source.
    """
    if needs.low_ms is None or needs.high_ms is None:
        return {"low": None, "high": None}, {"low": None, "high": None}
    frame_ms, latency_ms = report["frame_time_ms"]["mean"], report["latency_ms"]["mean"]
    if not _is_unsure(prices):
        return {"low": frame_ms, "high": frame_ms}, {"low": latency_ms, "high": latency_ms}
    frames = report["frames"]
    count = min(frames["requested"], SIMULATED_FRAMES * frames["requested"] // max(frames["presented"], 1))
    settings = settings_of(file, count, seed, hang_ns=NEVER_HANGS_NS)
    runs = {
        end: simulate(graph, settings, Drawn(prices, seed, factors_at(prices, end)), skips=skips_of(file, seed)).report
        for end in ENDS
    }

    def around_mean(key: str, mean: float) -> dict[str, float | None]:
        """Return the interval around `mean`, with the relative width that the three short runs give for `key`."""
        usual = runs["expected"][key]["mean"]
        _, low, high = over_ends(lambda end: mean * runs[end][key]["mean"] / usual if usual else mean)
        return {"low": low, "high": high}

    if frames["dropped"]:
        return around_mean("frame_time_ms", frame_ms), around_mean("latency_ms", latency_ms)
    least = source_ns(file) / NS_PER_MS
    by_bound: dict[str, float | None] = {"low": max(least, needs.low_ms), "high": max(least, needs.high_ms)}
    return by_bound, around_mean("latency_ms", latency_ms)
