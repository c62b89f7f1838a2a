"""The signals that end a command, and how they end it: as Ctrl-C does, so that what was begun is finished or removed.

Rule: this imports nothing of Trilane; it is the first thing that a command does.
"""

from __future__ import annotations

import contextlib
import os
import signal
from collections.abc import Iterator
from types import FrameType
from typing import NoReturn

#: Signals that end a command. SIGXCPU comes where a limit of CPU time is reached (`ulimit -t`).
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
    """Say which signal came, which nobody has typed, and end as Ctrl-C does."""
    with contextlib.suppress(OSError):  # of a terminal that was closed
        os.write(2, f"interrupted by {signal.Signals(number).name}\n".encode())
    raise KeyboardInterrupt(number)


def that_end() -> list[signal.Signals]:
    """Return SIGINT, SIGTERM, and the other signals of ENDING that the caller neither ignores nor handles.

    A command that was started by `nohup` or as a shell's background job ignores some.
    """
    always = (signal.SIGINT, signal.SIGTERM)
    return [number for number in ENDING if number in always or signal.getsignal(number) in (signal.SIG_DFL, _raise)]


@contextlib.contextmanager
def interrupting() -> Iterator[None]:
    """Let each signal that ends a command, but for SIGINT, end it as Ctrl-C does, and say its name."""
    before = {number: signal.signal(number, _raise) for number in that_end() if number != signal.SIGINT}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
