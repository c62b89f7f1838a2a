"""The process that units are forked from. Rule: it has one thread and ends with its parent; its units may outlive it.

`python -P -m trilane.pipeline.fork_server --socket FD --parent PID --preload MODULE,...` imports once the modules that
every unit needs, then forks a unit for each request. Therefore a unit starts in milliseconds, without imports of its
own.

A request is one packet on a SOCK_SEQPACKET socket: JSON with descriptors. The descriptors are the unit's spec, stderr
and lifeline, and the descriptors that the spec names. The spec is a memory file with JSON for the unit's loop. The
answer is the unit's process id with its pidfd and a pipe. When the unit has ended, the server writes the exit code to
this pipe, negative for a signal. A request with the key `call` names a function to call in place of a unit to start.
The function's result goes to a pipe that comes with the request; the server gives no other answer.

A lifeline is a pipe whose other end only the parent has: the kernel kills the unit when that end is closed.
"""

from __future__ import annotations

import argparse
import contextlib
import ctypes
import fcntl
import gc
import importlib
import json
import os
import select
import signal
import socket
import sys
import traceback
from collections.abc import Sequence
from typing import Any

from trilane.signals import ENDING

PR_SET_PDEATHSIG, PR_SET_NAME = 1, 15  # <linux/prctl.h>
F_SETSIG = 10  # <linux/fcntl.h>
MAX_FDS = 250  # most descriptors in one packet; SCM_MAX_FD of Linux is 253
PACKET_BYTES = 1 << 16
ALWAYS = "trilane.pipeline.unit_loop"
#: Environment variables from which libraries read their number of threads when they are loaded.
THREAD_LIMITS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMEXPR_NUM_THREADS")


def process_name(unit: str) -> str:
    """Return the kernel's name for the process of `unit` (`ps -o comm`), which has at most 15 bytes."""
    return f"trilane-{unit}"[:15]


def serve(requests: socket.socket) -> None:
    """Fork a unit for each request, until the other end of `requests` is closed and every unit has ended."""
    server_pid = os.getpid()
    codes: dict[int, int] = {}  # pipe for the exit code of each living unit, by process id
    signal.signal(signal.SIGCHLD, lambda _number, _frame: _reap(codes, os.WNOHANG))
    while True:
        packet, fds, _flags, _address = socket.recv_fds(requests, PACKET_BYTES, MAX_FDS)
        if not packet:
            break
        request = json.loads(packet)
        signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGCHLD})  # a unit that dies at once keeps its process id
        reads, writes = os.pipe2(os.O_CLOEXEC)
        # This process has one thread. A lock that another thread held at a fork would stay locked in the child for
        # ever.
        pid = os.fork()
        if pid == 0:
            requests.close()
            for fd in (reads, writes, *codes.values()):
                os.close(fd)
            os._exit(_call(request, fds, server_pid) if "call" in request else _run_unit(request, fds))
        codes[pid] = writes
        if "call" not in request:
            pidfd = os.pidfd_open(pid)
            socket.send_fds(requests, [str(pid).encode()], [pidfd, reads])
            os.close(pidfd)
        os.close(reads)
        signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGCHLD})
        for fd in fds:
            os.close(fd)
    signal.signal(signal.SIGCHLD, signal.SIG_DFL)
    _reap(codes, 0)


def _reap(codes: dict[int, int], options: int) -> None:
    """Reap units that have ended, and write their exit codes to their pipes.

    `options`: WNOHANG: reap the units that have ended by now; 0: wait for the ends of all units.
    """
    with contextlib.suppress(ChildProcessError):
        while (ended := os.waitpid(-1, options))[0]:
            writes = codes.pop(ended[0])
            with contextlib.suppress(BrokenPipeError):  # nobody asks
                os.write(writes, str(os.waitstatus_to_exitcode(ended[1])).encode())
            os.close(writes)


def _run_unit(request: dict[str, Any], fds: Sequence[int]) -> int:
    """Run the whole life of a unit in the forked process, and return its exit code."""
    try:
        spec_fd, stderr_fd, lifeline, *passed = fds
        _die_with(lifeline)
        os.dup2(stderr_fd, sys.stderr.fileno())
        os.close(stderr_fd)
        _leave_server()
        os.setpgid(0, 0)
        ctypes.CDLL(None).prctl(PR_SET_NAME, process_name(request["unit"]).encode(), 0, 0, 0)
        os.sched_setaffinity(0, request["cores"])
        # Set before the unit's own imports, because libraries read it when they are loaded.
        os.environ |= dict.fromkeys(THREAD_LIMITS, str(request["threads"]))
        spec = json.loads(os.pread(spec_fd, os.fstat(spec_fd).st_size, 0))
        os.close(spec_fd)
        loop = importlib.import_module(ALWAYS)
        code: int = loop.serve(spec, dict(zip(request["fds"], passed, strict=True)))
    except BaseException:
        traceback.print_exc()
        code = 1
    sys.stderr.flush()
    return code


def _call(request: dict[str, Any], fds: Sequence[int], server_pid: int) -> int:
    """Call the function `request["call"]`, write its result to `fds[0]` as JSON, and return the process's exit code."""
    _leave_server()
    die_with_parent(server_pid)
    module, _, name = request["call"].partition(":")
    try:
        answer = json.dumps(getattr(importlib.import_module(module), name)())
    except Exception:
        return 1
    with os.fdopen(fds[0], "w") as file:
        file.write(answer)
    return 0


def _leave_server() -> None:
    """In a forked process, restore the default action of signals. Only SIGINT stays ignored: the parent handles it."""
    for number in {signal.SIGCHLD, *ENDING} - {signal.SIGINT}:
        signal.signal(number, signal.SIG_DFL)
    signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGCHLD})


def _die_with(lifeline: int) -> None:
    """Let the kernel kill this process when the other end of its lifeline is closed.

    If the other end is closed already, this process ends now. Unlike a parent-death signal, a lifeline does not depend
    on which process or thread forked this process.
    """
    fcntl.fcntl(lifeline, F_SETSIG, signal.SIGKILL)
    fcntl.fcntl(lifeline, fcntl.F_SETOWN, os.getpid())
    fcntl.fcntl(lifeline, fcntl.F_SETFL, fcntl.fcntl(lifeline, fcntl.F_GETFL) | os.O_ASYNC)
    poller = select.poll()  # select(2) takes no descriptor above 1023
    poller.register(lifeline, 0)
    if poller.poll(0):
        os._exit(1)


def die_with_parent(parent_pid: int, number: int = signal.SIGKILL) -> None:
    """Let the kernel send this process the signal `number` when its parent ends.

    If the parent has ended already, end this process now. Raises OSError if the kernel refuses.

    `parent_pid`: process id of the parent.
    """
    libc = ctypes.CDLL(None, use_errno=True)
    if libc.prctl(PR_SET_PDEATHSIG, number, 0, 0, 0) != 0:
        raise OSError(ctypes.get_errno(), "prctl(PR_SET_PDEATHSIG)")
    # A parent that ended before the call above sends no signal any more.
    if os.getppid() != parent_pid:
        os._exit(1)


def main() -> None:
    parser = argparse.ArgumentParser(description="Forks the units of a run; started by Trilane, not by hand.")
    parser.add_argument("--socket", type=int, required=True)
    parser.add_argument("--parent", type=int, required=True)
    parser.add_argument("--preload", default="")
    arguments = parser.parse_args()
    die_with_parent(arguments.parent)
    for number in ENDING:  # the parent decides what these signals end
        signal.signal(number, signal.SIG_IGN)
    importlib.import_module(ALWAYS)
    for module in filter(None, arguments.preload.split(",")):
        with contextlib.suppress(ImportError):  # the unit that needs the module reports the error
            importlib.import_module(module)
    gc.collect()
    gc.freeze()  # a unit's garbage collector would write to, and so copy, the pages that all units share
    serve(socket.socket(fileno=arguments.socket))
    os._exit(0)  # a normal exit would unload all modules while the parent waits


if __name__ == "__main__":
    main()
