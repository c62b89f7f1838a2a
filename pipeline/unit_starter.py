"""The unit starter, the parent process's end of the fork server. Rule: after its end, no process is left behind.

If the fork server dies, its units live on. A server that has ended, or that a signal has stopped, is replaced. The
caller calls `renew` from time to time, so that a new server has imported its modules before the next unit must start.
"""

from __future__ import annotations

import contextlib
import json
import os
import select
import socket
import subprocess
import sys
import time
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, NamedTuple, Self

from trilane import machine
from trilane.errors import TrilaneError
from trilane.pipeline.fork_server import THREAD_LIMITS

if TYPE_CHECKING:
    from trilane.pipeline.unit_loop import UnitSpec

ANSWER_S = 60.0  # longest wait for an answer; the modules to preload may come from a slow disk
LOOK_S = 0.1  # time between two checks of a fork server that has not answered
CLOSE_S = 5.0
NOTICE_S = 0.2  # longest time from a failed call or a closed socket to the end of the fork server
TAIL_BYTES = 8192
DESCRIPTORS = 2  # number of descriptors that come with a unit's process id
SERVER = "the fork server, which every unit comes from,"
SERVERS = 3  # number of servers that are tried for one unit


class StartedUnit(NamedTuple):
    """A unit's process. The caller must close the descriptors.

    `pid`: process id.
    `pidfd`: descriptor that is readable when the unit's process has ended.
    `lifeline`: descriptor whose closing kills the unit's process. It also closes when the calling process ends.
    `code_fd`: pipe from which the exit code can be read as text soon after the end of the unit's process. The code is
    negative for a signal, and empty if the fork server has ended.
    """

    pid: int
    pidfd: int
    lifeline: int
    code_fd: int


class _ServerError(Exception):
    """The fork server does not answer."""


class ForkedCall:
    """A call of a function in a process that the fork server of `starter` forks.

    `function`: function as `module:name`.
    `reads`: descriptor from which the function's result is read.
    """

    def __init__(self, starter: UnitStarter, function: str, reads: int) -> None:
        self._starter, self._function, self._reads = starter, function, reads
        self._is_open = True

    def result(self) -> Any | None:
        """Return the function's result; None if the function failed or gave no result in ANSWER_S. Call this once.

        If the fork server ended or was stopped meanwhile, the function is called once more by a new server.
        """
        answer = self._answer()
        self.close()
        if not answer and self._starter.renew(NOTICE_S):
            self._reads, self._is_open = self._starter.send_call(self._function), True
            answer = self._answer()
            self.close()
        try:
            return json.loads(answer)
        except ValueError:  # empty or cut off
            return None

    def _answer(self) -> bytes:
        """Return the bytes from the pipe, until it is closed, ANSWER_S is over, or the fork server is in trouble."""
        answer = b""
        poller = select.poll()  # select(2) takes no descriptor above 1023
        poller.register(self._reads, select.POLLIN)
        end = time.monotonic() + ANSWER_S
        while time.monotonic() < end:
            if poller.poll(1000 * LOOK_S):
                if not (chunk := os.read(self._reads, TAIL_BYTES)):
                    break
                answer += chunk
            elif self._starter.trouble():
                break
        return answer

    def close(self) -> None:
        """Stop waiting for an answer."""
        if self._is_open:
            self._is_open = False
            os.close(self._reads)


class UnitStarter:
    """A fork server that imports the modules `preload` in the background.

    Close the starter when its units have ended. Raises OSError if no process can be made.
    """

    def __init__(self, preload: Sequence[str] = ()) -> None:
        self._preload = ",".join(preload)
        self._stderr = os.memfd_create("trilane:stderr", os.MFD_CLOEXEC)
        try:
            self._launch()
        except OSError:
            os.close(self._stderr)
            raise

    def _launch(self) -> None:
        self._has_units = False
        with contextlib.ExitStack() as undo, contextlib.ExitStack() as ended:
            self._socket, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
            undo.callback(self._socket.close)
            ended.callback(theirs.close)
            self._socket.settimeout(LOOK_S)
            self._server = self._spawn(theirs)
            undo.pop_all()

    def _spawn(self, theirs: socket.socket) -> subprocess.Popen[bytes]:
        arguments = [f"--socket={theirs.fileno()}", f"--parent={os.getpid()}", f"--preload={self._preload}"]
        return subprocess.Popen(
            [sys.executable, "-P", "-m", "trilane.pipeline.fork_server", *arguments],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=self._stderr,
            pass_fds=[theirs.fileno()],
            # One thread for each library: a fork copies only the thread that forks.
            env={**os.environ, **dict.fromkeys(THREAD_LIMITS, "1")},
            # Ctrl-C then reaches only the parent, which decides what is finished first.
            process_group=0,
        )

    def renew(self, wait_s: float = 0.0) -> str:
        """If the fork server has ended or was stopped, replace it and return the reason; else return "".

        `wait_s`: longest time in seconds to wait for the server's end.

        Raises OSError if no process can be made.
        """
        why = self.trouble(wait_s)
        if why:
            self._replace()
        return why

    def trouble(self, wait_s: float = 0.0) -> str:
        """Return the reason why the fork server no longer answers; "" if it may still answer.

        `wait_s`: longest time in seconds to wait for the server's end.
        """
        try:
            code = self._server.wait(wait_s)
        except subprocess.TimeoutExpired:
            return f"{SERVER} was stopped" if is_stopped(self._server.pid) else ""
        return f"{SERVER} " + (f"was killed by signal {-code}" if code < 0 else f"ended with exit code {code}")

    def _replace(self) -> None:
        self._end()
        self._launch()

    def start(self, spec: UnitSpec, stderr_fd: int) -> StartedUnit:
        """Start a process for the unit, and return it. `stderr_fd`: descriptor that becomes the process's stderr.

        Raises TrilaneError if the unit cannot be started.
        """
        try:
            spec_fd = os.memfd_create(f"trilane:spec:{spec.unit}", os.MFD_CLOEXEC)
            try:
                os.write(spec_fd, spec.model_dump_json().encode())
                self.renew()
                for server in range(SERVERS):
                    if server:
                        self._replace()
                    try:
                        return self._ask(spec, [spec_fd, stderr_fd])
                    except _ServerError as error:
                        why = str(error)
            finally:
                os.close(spec_fd)
        except OSError as error:
            why = error.strerror or str(error)
        raise TrilaneError(f"unit {spec.unit} could not be started: {why}")

    def _ask(self, spec: UnitSpec, fds: Sequence[int]) -> StartedUnit:
        """Request the unit's process from the fork server, and return it. After an error no process is left."""
        self._has_units = True
        settings = spec.settings
        request = {"unit": spec.unit, "cores": settings.cores, "threads": settings.threads, "fds": spec.fds}
        theirs, lifeline = os.pipe2(os.O_CLOEXEC)
        with contextlib.ExitStack() as undo:
            undo.callback(os.close, lifeline)
            try:
                socket.send_fds(self._socket, [json.dumps(request).encode()], [*fds, theirs, *spec.fds])
            except (BrokenPipeError, ConnectionResetError):
                raise _ServerError(self._why()) from None
            finally:
                os.close(theirs)
            answer, received = self._received()
            if not answer:
                raise _ServerError(self._why())
            if len(received) < DESCRIPTORS:
                for fd in received:
                    os.close(fd)
                raise TrilaneError(f"unit {spec.unit} could not be started: too many open files: ulimit -n 4096")
            undo.pop_all()
        return StartedUnit(int(answer), received[0], lifeline, received[1])

    def _received(self) -> tuple[bytes, list[int]]:
        """Return (answer, descriptors with it); both are empty if the server is gone, or takes longer than ANSWER_S."""
        end = time.monotonic() + ANSWER_S
        while time.monotonic() < end:
            with contextlib.suppress(TimeoutError, ConnectionResetError):
                answer, fds, _flags, _address = socket.recv_fds(self._socket, 32, DESCRIPTORS)
                return answer, fds
            if self.trouble():
                break
        return b"", []

    def call(self, function: str) -> ForkedCall:
        """Call a function in a process of its own.

        `function`: function as `module:name`; it must take no argument and return JSON values.
        """
        return ForkedCall(self, function, self.send_call(function))

    def send_call(self, function: str) -> int:
        """Request a call of `function`, and return the descriptor from which its result is read.

        If the fork server is gone, the descriptor gives no bytes.
        """
        reads, writes = os.pipe2(os.O_CLOEXEC)
        try:
            with contextlib.suppress(BrokenPipeError, ConnectionResetError):
                socket.send_fds(self._socket, [json.dumps({"call": function}).encode()], [writes])
        finally:
            os.close(writes)
        return reads

    def close(self) -> None:
        """End the fork server. If it has started units, it first waits for their ends, but no longer than CLOSE_S."""
        self._end()
        os.close(self._stderr)

    def _end(self) -> None:
        self._socket.close()
        if not self._has_units or self.trouble():
            self._server.kill()  # it may still be importing, or a call may still run
        try:
            self._server.wait(CLOSE_S)
        except subprocess.TimeoutExpired:
            self._server.kill()
            self._server.wait()

    def _why(self) -> str:
        """Return the reason why the server does not answer: a signal, or the last line of its stderr."""
        trouble = self.trouble(NOTICE_S)
        if trouble and self._server.returncode not in range(1, 256):
            return trouble
        size = os.fstat(self._stderr).st_size
        tail = os.pread(self._stderr, TAIL_BYTES, max(0, size - TAIL_BYTES)).decode(errors="replace").strip()
        if tail:
            return tail.splitlines()[-1]
        return trouble or f"the fork server gave no answer in {ANSWER_S:.0f} s"

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_exc: object) -> None:
        self.close()


def is_stopped(pid: int) -> bool:
    """Return whether a signal has stopped the process, as SIGSTOP does; False for a process that is gone."""
    try:
        stat = (machine.here.proc / f"{pid}/stat").read_text(encoding="ascii", errors="replace")
    except OSError:
        return False
    return stat.rpartition(")")[2].split()[0] == "T"
