"""The parent's end of the fork server. Rule: it starts units, and leaves no process when it is closed."""

from __future__ import annotations

import contextlib
import json
import os
import select
import signal
import socket
import subprocess
import sys
from collections.abc import Callable, Sequence
from functools import partial
from typing import TYPE_CHECKING, Any, NamedTuple, Self

from trilane.errors import TrilaneError
from trilane.pipeline.fork_server import THREAD_LIMITS

if TYPE_CHECKING:
    from trilane.pipeline.unit_spec import UnitSpec

ANSWER_S = 60.0  # the modules to preload may come from a slow disk
CLOSE_S = 5.0
NOTICE_S = 0.2  # from the end of its units to its own, which ended them
TAIL_BYTES = 8192


class StartedUnit(NamedTuple):
    """A unit's process. `pidfd`: readable when it has ended; to be closed by who has it."""

    pid: int
    pidfd: int


class ForkedCall:
    """A call that goes on in another process; `server_end` says why the fork server has ended, "" while it lives."""

    def __init__(self, reads: int, server_end: Callable[[], str]) -> None:
        self._reads, self._server_end = reads, server_end
        self._is_open = True

    def result(self) -> Any | None:
        """What the function returned, once; None when it failed, its process died, or no answer came in time.

        Raises TrilaneError when the fork server has ended, and the call with it.
        """
        answer = b""
        poller = select.poll()  # select(2) takes no descriptor above 1023
        poller.register(self._reads, select.POLLIN)
        while poller.poll(1000 * ANSWER_S) and (chunk := os.read(self._reads, TAIL_BYTES)):
            answer += chunk
        self.close()
        if not answer and (end := self._server_end()):
            raise TrilaneError(end)
        return json.loads(answer) if answer else None

    def close(self) -> None:
        """Take no answer any more."""
        if self._is_open:
            self._is_open = False
            os.close(self._reads)


class UnitStarter:
    """A fork server with the modules `preload` imported; it imports them while the caller goes on.

    Close it when its units have ended. Raises OSError when no process can be made.
    """

    def __init__(self, preload: Sequence[str] = ()) -> None:
        with contextlib.ExitStack() as undo, contextlib.ExitStack() as ended:
            self._socket, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
            undo.callback(self._socket.close)
            ended.callback(theirs.close)
            self._stderr = os.memfd_create("trilane:stderr", os.MFD_CLOEXEC)
            undo.callback(os.close, self._stderr)
            self._server = self._spawn(theirs, preload)
            undo.pop_all()
        self._socket.settimeout(ANSWER_S)
        self._has_units = False

    def _spawn(self, theirs: socket.socket, preload: Sequence[str]) -> subprocess.Popen[bytes]:
        arguments = [f"--socket={theirs.fileno()}", f"--parent={os.getpid()}", f"--preload={','.join(preload)}"]
        return subprocess.Popen(
            [sys.executable, "-P", "-m", "trilane.pipeline.fork_server", *arguments],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=self._stderr,
            pass_fds=[theirs.fileno()],
            env={**os.environ, **dict.fromkeys(THREAD_LIMITS, "1")},
            process_group=0,
        )

    def start(self, spec: UnitSpec, stderr_fd: int) -> StartedUnit:
        """A process for the unit, which writes to `stderr_fd`. Raises TrilaneError when the fork server failed."""
        self._has_units = True
        spec_fd = os.memfd_create(f"trilane:spec:{spec.unit}", os.MFD_CLOEXEC)
        try:
            os.write(spec_fd, spec.model_dump_json().encode())
            settings = spec.settings
            request = {"unit": spec.unit, "cores": settings.cores, "threads": settings.threads, "fds": spec.fds}
            socket.send_fds(self._socket, [json.dumps(request).encode()], [spec_fd, stderr_fd, *spec.fds])
            answer, fds, _flags, _address = socket.recv_fds(self._socket, 32, 1)
        except OSError as error:
            raise TrilaneError(f"unit {spec.unit} could not be started: {self._reason(error)}") from None
        finally:
            os.close(spec_fd)
        if not answer:
            raise TrilaneError(f"unit {spec.unit} could not be started: {self._reason(None)}")
        if not fds:
            raise TrilaneError(f"unit {spec.unit} could not be started: too many open files: ulimit -n 4096")
        return StartedUnit(int(answer), fds[0])

    def call(self, function: str) -> ForkedCall:
        """Call `module:name`, which takes nothing and returns what JSON takes, in a process of its own.

        Raises TrilaneError when the fork server has ended.
        """
        reads, writes = os.pipe2(os.O_CLOEXEC)
        try:
            socket.send_fds(self._socket, [json.dumps({"call": function}).encode()], [writes])
        except OSError as error:
            os.close(reads)
            raise TrilaneError(f"{function} could not be called: {self._reason(error)}") from None
        finally:
            os.close(writes)
        return ForkedCall(reads, partial(self.end, NOTICE_S))

    def close(self) -> None:
        """End the fork server; units that still live end with it."""
        self._socket.close()
        if not self._has_units:
            self._server.kill()  # it may still be importing, or a call go on
        try:
            self._server.wait(CLOSE_S)
        except subprocess.TimeoutExpired:
            self._server.send_signal(signal.SIGKILL)
            self._server.wait()
        os.close(self._stderr)

    def end(self, wait_s: float = 0.0) -> str:
        """Why the fork server has ended; "" when it still lives after the time."""
        try:
            code = self._server.wait(wait_s)
        except subprocess.TimeoutExpired:
            return ""
        how = f"was killed by signal {-code}" if code < 0 else f"ended with exit code {code}"
        return f"the fork server, which every unit comes from, {how}"

    def _reason(self, error: OSError | None) -> str:
        """The end of what the fork server wrote, else how it ended, else the error's own words."""
        size = os.fstat(self._stderr).st_size
        tail = os.pread(self._stderr, TAIL_BYTES, max(0, size - TAIL_BYTES)).decode(errors="replace").strip()
        if tail:
            return tail.splitlines()[-1]
        return self.end(NOTICE_S) or ("no answer" if error is None else error.strerror or str(error))

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_exc: object) -> None:
        self.close()
