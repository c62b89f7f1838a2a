"""The units' processes, seen from the parent. Rule: what was started here is ended here, and its end is always noticed.

A unit speaks over its link, its stderr over a pipe, and its death over a pidfd; all are waited for at once.
"""

from __future__ import annotations

import contextlib
import os
import resource
import select
import subprocess
import sys
import time
from collections.abc import Callable, Mapping
from functools import partial
from typing import NamedTuple

import zmq

from trilane.errors import TrilaneError
from trilane.pipeline.unit_loop import EdgeSpec, UnitSpec
from trilane.stages.config import RunConfig
from trilane.transport.job_pipe import JobPipe, JobPipeEnd, job_pipe_pair
from trilane.transport.link import Link
from trilane.transport.messages import Message, MessageError
from trilane.transport.socket_folder import SocketFolder

TAIL_BYTES = 8192
END_S = 2.0
#: Libraries that make threads of their own read these; set before they are imported.
THREAD_LIMITS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMEXPR_NUM_THREADS")
#: Files and sockets that a run holds open, with room for a unit that is restarted.
LEAST_FILES = 96


class UnitMessage(NamedTuple):
    """Something from a unit: a message, or None when its process has ended."""

    unit: str
    message: Message | None


class _Process:
    def __init__(self, unit: str, popen: subprocess.Popen[bytes], link: Link, folder: SocketFolder) -> None:
        assert popen.stderr is not None
        self.unit, self.popen, self.link, self.folder = unit, popen, link, folder
        self.stderr = popen.stderr
        self.pidfd = os.pidfd_open(popen.pid)
        self.tail = b""
        self.folder_open = True
        os.set_blocking(self.stderr.fileno(), False)

    def read_stderr(self) -> bool:
        """Keep the end of what was written; False when the pipe is closed."""
        with contextlib.suppress(BlockingIOError):
            while chunk := os.read(self.stderr.fileno(), TAIL_BYTES):
                self.tail = (self.tail + chunk)[-TAIL_BYTES:]
            return False
        return True

    def release_folder(self) -> None:
        if self.folder_open:
            self.folder_open = False
            self.folder.remove()


class UnitProcesses:
    """Starts, hears and ends the processes of the units in `stages` (unit -> stage -> input and output edge)."""

    def __init__(
        self,
        config: RunConfig,
        edges: Mapping[str, EdgeSpec],
        stages: Mapping[str, Mapping[str, tuple[str | None, str | None]]],
    ) -> None:
        self._config, self._edges, self._stages = config, edges, stages
        self._context = zmq.Context()
        self._poller = select.epoll()
        self._reactions: dict[int, Callable[[], list[UnitMessage]]] = {}
        self._live: dict[str, _Process] = {}
        self._ended: list[_Process] = []
        #: Stage -> its number among those of its unit, as messages have it.
        self.places = {stage: place for own in stages.values() for place, stage in enumerate(own)}
        self.last_words: dict[str, str] = {}

    @property
    def pids(self) -> dict[str, int]:
        return {unit: process.popen.pid for unit, process in self._live.items()}

    def watch(self, fd: int) -> None:
        """Let `listen` return early when `fd` becomes readable."""
        self._register(fd, partial(_swallow, fd))

    def start(self, unit: str) -> None:
        """A fresh process for the unit; `Ready` or `Failed` follows, or its end. Raises TrilaneError, OSError."""
        with contextlib.ExitStack() as undo:
            folder = SocketFolder()
            undo.callback(folder.remove)
            ours, theirs = job_pipe_pair()
            link = Link(self._context, JobPipe(ours))
            undo.callback(link.close)
            with contextlib.closing(theirs):
                link.bind(folder.endpoint(unit))
                popen = self._spawn(unit, self._spec(unit, folder, theirs))
            undo.callback(_end_now, popen)
            process = _Process(unit, popen, link, folder)
            undo.pop_all()
        self._live[unit] = process
        self._register(link.job_pipe.fileno(), partial(self._work, process))
        self._register(link.heartbeat_fd, partial(self._life_signs, process))
        self._register(process.stderr.fileno(), partial(self._stderr, process))
        self._register(process.pidfd, partial(self._end, process))

    def connected(self, unit: str) -> None:
        """The unit has spoken: its socket needs no name any more."""
        if unit in self._live:
            self._live[unit].release_folder()

    def send(self, unit: str, message: Message) -> None:
        """To a unit that is gone or does not read: nothing, its end or its deadline tells."""
        process = self._live.get(unit)
        if process is not None:
            process.link.job_pipe.send(message)

    def kill(self, unit: str) -> None:
        if unit in self._live:
            self._live[unit].popen.kill()

    def listen(self, timeout_ms: int) -> list[UnitMessage]:
        """What came within the time; at once when something waits. Messages of a unit come before its end."""
        heard: list[UnitMessage] = []
        for fd, _ in self._poller.poll(timeout_ms / 1000):
            heard += self._reactions[fd]()
        while self._ended:
            process = self._ended.pop()
            while work := self._work(process):
                heard += work
            heard += self._life_signs(process)
            self._forget(process)
            heard.append(UnitMessage(process.unit, None))
        return heard

    def end_all(self) -> None:
        """No process is left when this returns, however it was before."""
        for process in list(self._live.values()):
            process.popen.kill()
        for process in list(self._live.values()):
            self._forget(process)
        self._context.destroy(linger=0)
        self._poller.close()

    def wait_for_end(self, units: list[str], timeout_s: float = END_S) -> None:
        """Give units that were told to close the time to leave by themselves."""
        end = time.monotonic() + timeout_s
        while any(unit in self._live for unit in units) and time.monotonic() < end:
            self.listen(50)

    def _work(self, process: _Process) -> list[UnitMessage]:
        """The next message of the line, if there is one; the others make it readable again."""
        try:
            message = process.link.job_pipe.receive()
        except MessageError as error:
            raise _no_message(process, error) from None
        if message is not None:
            return [UnitMessage(process.unit, message)]
        if process.link.job_pipe.ended:
            self._unregister(process.link.job_pipe.fileno())  # it would be readable for ever
        return []

    def _life_signs(self, process: _Process) -> list[UnitMessage]:
        try:
            return [UnitMessage(process.unit, message) for message in process.link.heartbeats()]
        except MessageError as error:
            raise _no_message(process, error) from None

    def _stderr(self, process: _Process) -> list[UnitMessage]:
        if not process.read_stderr():
            self._unregister(process.stderr.fileno())
        return []

    def _end(self, process: _Process) -> list[UnitMessage]:
        self._ended.append(process)
        return []

    def _spec(self, unit: str, folder: SocketFolder, line: JobPipeEnd) -> UnitSpec:
        stages = dict(self._stages[unit])
        used = {edge for pair in stages.values() for edge in pair if edge is not None}
        return UnitSpec(
            parent_pid=os.getpid(),
            endpoint=folder.endpoint(unit),
            line=line,
            config=self._config,
            edges={name: self._edges[name] for name in used},
            stages=stages,
        )

    def _spawn(self, unit: str, spec: UnitSpec) -> subprocess.Popen[bytes]:
        fd = os.memfd_create(f"trilane:spec:{unit}", os.MFD_CLOEXEC)
        try:
            os.write(fd, spec.model_dump_json().encode())
            threads = str(self._config.units[unit].threads)
            return subprocess.Popen(
                [sys.executable, "-P", "-m", "trilane.pipeline.worker", "--unit", unit, "--spec", str(fd)],
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
                stderr=subprocess.PIPE,
                pass_fds=[fd, *spec.line, *(edge.fd for edge in spec.edges.values())],
                env={**os.environ, **dict.fromkeys(THREAD_LIMITS, threads), "TRILANE_UNIT": unit},
                process_group=0,
            )
        finally:
            os.close(fd)

    def _forget(self, process: _Process) -> None:
        process.popen.wait()
        process.read_stderr()
        self.last_words[process.unit] = process.tail.decode(errors="replace").strip()
        for fd in (process.link.job_pipe.fileno(), process.link.heartbeat_fd, process.stderr.fileno(), process.pidfd):
            self._unregister(fd)
        process.link.close()
        process.release_folder()
        os.close(process.pidfd)
        process.stderr.close()
        del self._live[process.unit]

    def _register(self, fd: int, reaction: Callable[[], list[UnitMessage]]) -> None:
        self._poller.register(fd, select.EPOLLIN)
        self._reactions[fd] = reaction

    def _unregister(self, fd: int) -> None:
        if self._reactions.pop(fd, None) is not None:
            self._poller.unregister(fd)


def check_open_files() -> None:
    """Raises TrilaneError when this process may open too few files for a run."""
    limit = resource.getrlimit(resource.RLIMIT_NOFILE)[0]
    if limit != resource.RLIM_INFINITY and limit < LEAST_FILES:
        raise TrilaneError(f"open files: found a limit of {limit}, expected at least {LEAST_FILES}: ulimit -n 1024")


def _end_now(popen: subprocess.Popen[bytes]) -> None:
    popen.kill()
    popen.communicate()


def _swallow(fd: int) -> list[UnitMessage]:
    os.read(fd, 64)
    return []


def _no_message(process: _Process, error: MessageError) -> TrilaneError:
    return TrilaneError(f"unit {process.unit} sent what is no message: {error}")
