"""Starts the units' processes, receives their messages, and ends them.

Rule: every process that is started here is ended here, and its end is always noticed. This file has the time limits for
starts and ends.

A unit's messages come over its link (job pipe and heartbeat socket), and its stderr over a pipe. A pidfd shows the end
of its process. One poller waits for all of these.
"""

from __future__ import annotations

import contextlib
import os
import select
import signal
import time
from collections.abc import Callable, Iterable, Mapping
from functools import partial
from itertools import chain
from typing import NamedTuple

import zmq

from trilane import machine
from trilane.errors import TrilaneError
from trilane.machine import ended_by_system, shortage
from trilane.pipeline.controls import Interrupts
from trilane.pipeline.description import Pipeline
from trilane.pipeline.memory import EdgeRegion
from trilane.pipeline.result import RunLog, UnitError, after_stderr
from trilane.pipeline.unit_loop import UnitSpec
from trilane.pipeline.unit_starter import StartedUnit, UnitStarter, is_stopped
from trilane.transport.messages import (
    Close,
    Closed,
    Failed,
    JobPipe,
    JobPipeEnd,
    Link,
    Message,
    MessageError,
    Ready,
    SocketFolder,
    job_pipe_pair,
)

TAIL_BYTES = 8192
END_S = 2.0
#: Longest wait in ms for a unit's exit code from the fork server, which sends the code at once.
CODE_MS = 200


class UnitMessage(NamedTuple):
    """A message of a unit. `message`: None if the unit's process has ended."""

    unit: str
    message: Message | None


class _Process:
    def __init__(self, unit: str, started: StartedUnit, stderr_fd: int, link: Link, folder: SocketFolder) -> None:
        self.unit, self.pid, self.pidfd, self.lifeline, self.code_fd = unit, *started
        self.stderr_fd, self.link, self.folder = stderr_fd, link, folder
        self.tail = b""
        self.folder_open = True
        self.is_killed_here = False
        os.set_blocking(stderr_fd, False)

    def read_stderr(self) -> bool:
        """Read all available bytes of stderr, and keep the last TAIL_BYTES. Return False if the pipe is closed."""
        with contextlib.suppress(BlockingIOError):
            while chunk := os.read(self.stderr_fd, TAIL_BYTES):
                self.tail = (self.tail + chunk)[-TAIL_BYTES:]
            return False
        return True

    def kill(self) -> None:
        self.is_killed_here = True
        with contextlib.suppress(ProcessLookupError):
            # With a pidfd, the signal cannot reach another process that has got the same process id.
            signal.pidfd_send_signal(self.pidfd, signal.SIGKILL)

    def wait(self) -> None:
        """Wait until the process has ended, then kill the processes that it started (its process group)."""
        poller = select.poll()  # select(2) takes no descriptor above 1023
        poller.register(self.pidfd, select.POLLIN)
        poller.poll()
        with contextlib.suppress(ProcessLookupError):
            os.killpg(self.pid, signal.SIGKILL)

    def killed_by(self) -> int:
        """Return the number of the signal from outside this run that ended the process.

        Return 0 if `kill` or no signal ended the process, or if the fork server is gone and the signal is not known.
        """
        poller = select.poll()
        poller.register(self.code_fd, select.POLLIN)
        if self.is_killed_here or not poller.poll(CODE_MS):
            return 0
        return max(0, -int(os.read(self.code_fd, 16) or 0))

    def release_folder(self) -> None:
        if self.folder_open:
            self.folder_open = False
            self.folder.remove()


class UnitProcesses:
    """The processes of the units of `pipeline`.

    `regions`: shared memory of each edge, by the edge's name.
    `assets_fd`: descriptor of the assets.
    `starter`: fork server.
    `stderr_tails`: stderr tail of each unit's last process that has ended.
    `signals`: number of the signal from outside this run that ended the same process, by unit; 0: none is known.
    `places`: index of each stage among the stages of its unit, by the stage's name; messages use this index.
    """

    def __init__(
        self, pipeline: Pipeline, regions: Mapping[str, EdgeRegion], assets_fd: int, starter: UnitStarter
    ) -> None:
        self._pipeline, self._regions, self._assets_fd, self._starter = pipeline, regions, assets_fd, starter
        self._context = zmq.Context()
        self._poller = select.epoll()
        self._reactions: dict[int, Callable[[], list[UnitMessage]]] = {}
        self._live: dict[str, _Process] = {}
        self._ended: list[_Process] = []
        self.places = {
            stage.name: place for unit in pipeline.units for place, stage in enumerate(pipeline.stages_of(unit))
        }
        self.stderr_tails: dict[str, str] = {}
        self.signals: dict[str, int] = {}

    @property
    def core_counts(self) -> dict[str, int]:
        return {unit: len(settings.cores) for unit, settings in self._pipeline.units.items()}

    @property
    def pids(self) -> dict[str, int]:
        return {unit: process.pid for unit, process in self._live.items()}

    def watch(self, fd: int) -> None:
        """Let `listen` return early when `fd` becomes readable. Further calls for the same `fd` do nothing."""
        if fd not in self._reactions:
            self._register(fd, partial(_swallow, fd))

    def start(self, unit: str) -> None:
        """Start a new process for the unit. Raises TrilaneError or OSError.

        The unit's next message is `Ready` or `Failed`, or None for the end of the process.
        """
        with contextlib.ExitStack() as undo:
            folder = SocketFolder()
            undo.callback(folder.remove)
            ours, theirs = job_pipe_pair()
            link = Link(self._context, JobPipe(ours))
            undo.callback(link.close)
            with contextlib.closing(theirs):
                link.bind(folder.endpoint(unit))
                stderr_fd, theirs_stderr = os.pipe2(os.O_CLOEXEC)
                undo.callback(os.close, stderr_fd)
                try:
                    started = self._starter.start(self._spec(unit, folder, theirs), theirs_stderr)
                finally:
                    os.close(theirs_stderr)
            process = _Process(unit, started, stderr_fd, link, folder)
            undo.pop_all()
        self._live[unit] = process
        self._register(link.job_pipe.fileno(), partial(self._job_messages, process))
        self._register(link.heartbeat_fd, partial(self._heartbeats, process))
        self._register(process.stderr_fd, partial(self._stderr, process))
        self._register(process.pidfd, partial(self._end, process))

    def connected(self, unit: str) -> None:
        """Remove the file of the unit's socket, which a connected unit no longer needs."""
        if unit in self._live:
            self._live[unit].release_folder()

    def send(self, unit: str, message: Message) -> None:
        """Send `message` to the unit. If the unit is gone or does not read, do nothing.

        The scheduler notices this by the end of the unit's process, or by the unit's deadline.
        """
        process = self._live.get(unit)
        if process is not None:
            process.link.job_pipe.send(message)

    def kill(self, unit: str) -> None:
        if unit in self._live:
            self._live[unit].kill()

    def move(self, unit: str, cores: tuple[int, ...]) -> None:
        """Restrict every thread of the unit to `cores`, until its process ends."""
        with contextlib.suppress(ProcessLookupError, FileNotFoundError):  # `listen` hears of its end
            for thread in (machine.here.proc / f"{self._live[unit].pid}/task").iterdir():
                with contextlib.suppress(ProcessLookupError):  # the thread has ended meanwhile
                    os.sched_setaffinity(int(thread.name), cores)

    def listen(self, timeout_ms: int) -> list[UnitMessage]:
        """Return messages, after at most `timeout_ms`; a unit's end comes last. Raises TrilaneError for bad bytes."""
        messages: list[UnitMessage] = []
        for fd, _ in self._poller.poll(timeout_ms / 1000):
            messages += self._reactions[fd]()
        while self._ended:
            process = self._ended.pop()
            while unread := self._job_messages(process):
                messages += unread
            messages += self._heartbeats(process)
            self._forget(process)
            messages.append(UnitMessage(process.unit, None))
        return messages

    def why_ended(self, unit: str) -> str:
        """Return the end of a sentence about a unit's death, with all that is known about the cause.

        This may be the signal, the last line of stderr, and a lack of memory.
        """
        number = self.signals.get(unit, 0)
        killed = f"it was killed by signal {number}" if number else ""
        ends = (killed, after_stderr(self.stderr_tails.get(unit, "")), ended_by_system())
        return "".join(f"; {end}" for end in ends if end)

    @property
    def stopped(self) -> set[str]:
        """The names of the units whose processes a signal has stopped, as SIGSTOP does, and that have not gone on."""
        return {unit for unit, process in self._live.items() if is_stopped(process.pid)}

    def renew_starter(self) -> str:
        """Replace the fork server if it does not answer; return the reason, or "" if it answers. Raises OSError."""
        return self._starter.renew()

    def close(self) -> None:
        """Kill every process that still lives, and free all resources."""
        for process in list(self._live.values()):
            process.kill()
        for process in list(self._live.values()):
            self._forget(process)
        self._context.destroy(linger=0)
        self._poller.close()

    def wait_for_end(self, units: list[str], timeout_s: float = END_S) -> None:
        """Wait at most `timeout_s` seconds for the ends of the processes of `units`, which were told to close."""
        end = time.monotonic() + timeout_s
        while any(unit in self._live for unit in units) and time.monotonic() < end:
            self.listen(50)

    def _job_messages(self, process: _Process) -> list[UnitMessage]:
        """Return a list with the next message of the job pipe, if any. The pipe stays readable while more wait."""
        try:
            message = process.link.job_pipe.receive()
        except MessageError as error:
            raise _bad_message(process, error) from None
        if message is not None:
            return [UnitMessage(process.unit, message)]
        if process.link.job_pipe.ended:
            # otherwise the poller would report the closed pipe for ever
            self._unregister(process.link.job_pipe.fileno())
        return []

    def _heartbeats(self, process: _Process) -> list[UnitMessage]:
        try:
            return [UnitMessage(process.unit, message) for message in process.link.heartbeats()]
        except MessageError as error:
            raise _bad_message(process, error) from None

    def _stderr(self, process: _Process) -> list[UnitMessage]:
        if not process.read_stderr():
            self._unregister(process.stderr_fd)
        return []

    def _end(self, process: _Process) -> list[UnitMessage]:
        self._ended.append(process)
        return []

    def _spec(self, unit: str, folder: SocketFolder, job_pipe: JobPipeEnd) -> UnitSpec:
        pipeline, stages = self._pipeline, self._pipeline.stages_of(unit)
        inputs = {stage.name: edges for stage in stages if (edges := pipeline.edges_into(stage.name))}
        outputs = {before.name: name for name, (before, _) in pipeline.joints.items() if before.unit == unit}
        return UnitSpec(
            unit=unit,
            endpoint=folder.endpoint(unit),
            job_pipe=job_pipe,
            assets_fd=self._assets_fd,
            settings=pipeline.units[unit],
            scheduler_cores=pipeline.scheduler_cores,
            run_cores=pipeline.run_cores,
            stages=stages,
            module_folders=tuple(folder.absolute() for folder in pipeline.module_folders),
            edges={name: self._regions[name] for name in {*chain.from_iterable(inputs.values()), *outputs.values()}},
            inputs=inputs,
            outputs=outputs,
            may_skip=pipeline.bypass[0] if pipeline.bypass else "",
        )

    def _forget(self, process: _Process) -> None:
        process.wait()
        self.signals[process.unit] = process.killed_by()
        process.read_stderr()
        self.stderr_tails[process.unit] = process.tail.decode(errors="replace").strip()
        for fd in (process.link.job_pipe.fileno(), process.link.heartbeat_fd, process.stderr_fd, process.pidfd):
            self._unregister(fd)
        process.link.close()
        process.release_folder()
        os.close(process.pidfd)
        os.close(process.lifeline)
        os.close(process.code_fd)
        os.close(process.stderr_fd)
        del self._live[process.unit]

    def _register(self, fd: int, reaction: Callable[[], list[UnitMessage]]) -> None:
        self._poller.register(fd, select.EPOLLIN)
        self._reactions[fd] = reaction

    def _unregister(self, fd: int) -> None:
        if self._reactions.pop(fd, None) is not None:
            self._poller.unregister(fd)


def _swallow(fd: int) -> list[UnitMessage]:
    os.read(fd, 64)
    return []


def _bad_message(process: _Process, error: MessageError) -> TrilaneError:
    return TrilaneError(f"unit {process.unit} sent bytes that are not a message: {error}")


START_S = 120.0
CLOSE_S = 30.0
POLL_MS = 200


def start_units(processes: UnitProcesses, units: Iterable[str], interrupts: Interrupts) -> dict[str, float]:
    """Start `units`, wait until all are ready, and return the start-up time of each unit in ms.

    Raises TrilaneError or OSError if a unit cannot start, and KeyboardInterrupt when interrupted.
    """
    started_s = {}
    for unit in units:
        started_s[unit] = time.monotonic()
        processes.start(unit)
    waiting = set(started_s)
    end = time.monotonic() + START_S
    took_ms: dict[str, float] = {}
    while waiting:
        if time.monotonic() > end:
            raise UnitError(f"unit {', '.join(sorted(waiting))} was not ready after {START_S:.0f} s")
        for unit, message in listen_before_run(processes, interrupts):
            if isinstance(message, Ready):
                processes.connected(unit)
                took_ms[unit] = (time.monotonic() - started_s[unit]) * 1000
                waiting.discard(unit)
    return took_ms


def listen_before_run(processes: UnitProcesses, interrupts: Interrupts) -> list[UnitMessage]:
    """Return the next messages, after at most POLL_MS.

    Raises UnitError if a unit failed or ended, and KeyboardInterrupt when interrupted.
    """
    messages = processes.listen(POLL_MS)
    if interrupts.count:
        raise KeyboardInterrupt
    for unit, message in messages:
        if isinstance(message, Failed):
            raise UnitError(message.message, message.exit_code)
        if message is None:
            why = f"; memory is short: {short}" if (short := shortage()) else processes.why_ended(unit)
            raise UnitError(f"unit {unit} ended before the run began{why}")
    return messages


def close_units(processes: UnitProcesses, log: RunLog, interrupts: Interrupts) -> None:
    """Tell all units to close, and wait until their stages have completed their files and their processes have ended.

    A unit that fails, dies or takes too long is noted in `log` as a failure of the run. A process that does not end is
    left to `UnitProcesses.close`, which kills it.
    """
    waiting = set(processes.pids)
    for unit in waiting:
        processes.send(unit, Close())
    end = time.monotonic() + CLOSE_S
    # A second interrupt asks to end at once, so it ends the wait too.
    while waiting and time.monotonic() < end and interrupts.count < 2:
        for unit, message in processes.listen(POLL_MS):
            if isinstance(message, Failed):
                log.fail(message.message, message.exit_code)
                log.say(message.message)
            if message is None and unit in waiting:
                log.fail(f"unit {unit} ended before its files were closed{processes.why_ended(unit)}")
            if message is None or isinstance(message, Closed):
                waiting.discard(unit)
    if waiting and interrupts.count < 2:
        log.fail(f"unit {', '.join(sorted(waiting))} did not close its files")
    processes.wait_for_end(list(processes.pids))
