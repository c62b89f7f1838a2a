"""The signals that end a command. They act as Ctrl-C does, so that unfinished files are completed or removed.

Rule: this module imports nothing of Trilane, because a command imports it before anything else.
"""

from __future__ import annotations

import contextlib
import os
import signal
from collections.abc import Iterator
from types import FrameType
from typing import NoReturn

#: Exit code of a command that was interrupted.
INTERRUPTED = 130
#: Signals that end a command. The kernel sends SIGXCPU when a limit of CPU time is reached (`ulimit -t`).
ENDING = (
    signal.SIGINT,
    signal.SIGTERM,
    signal.SIGHUP,
    signal.SIGQUIT,
    signal.SIGUSR1,
    signal.SIGUSR2,
    signal.SIGXCPU,
)


def _raise(number: int, _frame: FrameType | None) -> NoReturn:
    """Write the signal's name to stderr, then raise KeyboardInterrupt as Ctrl-C does."""
    with contextlib.suppress(OSError):  # the terminal may be closed
        os.write(2, f"interrupted by {signal.Signals(number).name}\n".encode())
    raise KeyboardInterrupt(number)


def that_end() -> list[signal.Signals]:
    """Return SIGINT, SIGTERM, and all further signals of ENDING that have their default action (or `_raise`).

    A command that was started by `nohup`, or as a shell's background job, ignores some signals of ENDING.
    """
    always = (signal.SIGINT, signal.SIGTERM)
    return [number for number in ENDING if number in always or signal.getsignal(number) in (signal.SIG_DFL, _raise)]


@contextlib.contextmanager
def interrupting() -> Iterator[None]:
    """Make the signals of `that_end` raise KeyboardInterrupt inside the `with` block, as SIGINT does already."""
    before = {number: signal.signal(number, _raise) for number in that_end() if number != signal.SIGINT}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
