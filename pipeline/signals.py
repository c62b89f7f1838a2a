"""Turns signals that end a run into requests, so that they interrupt nothing. Rule: the handler only counts."""

from __future__ import annotations

import os
import signal
import threading
from types import FrameType
from typing import Any, Self

UNLESS_IGNORED = (signal.SIGHUP, signal.SIGQUIT)


class Interrupts:
    """Counts the signals and makes `fd` readable while entered from the main thread; in other threads it does nothing.

    SIGHUP and SIGQUIT stay ignored if the caller was started so (`nohup`, a shell's background job). SIGPIPE is ignored
    meanwhile, as Python does it: a message to a unit that is gone must not end the program.
    """

    def __init__(self) -> None:
        self.count = 0
        self.fd, self._write_fd = os.pipe2(os.O_NONBLOCK | os.O_CLOEXEC)
        self._before: dict[int, Any] = {}
        self._wakeup_before = -1

    def __enter__(self) -> Self:
        if threading.current_thread() is threading.main_thread():
            self._wakeup_before = signal.set_wakeup_fd(self._write_fd, warn_on_full_buffer=False)
            hears = [number for number in UNLESS_IGNORED if signal.getsignal(number) not in (signal.SIG_IGN, None)]
            for number in (signal.SIGINT, signal.SIGTERM, *hears):
                self._before[number] = signal.signal(number, self._count)
            self._before[signal.SIGPIPE] = signal.signal(signal.SIGPIPE, signal.SIG_IGN)
        return self

    def __exit__(self, *_exc: object) -> None:
        for number, handler in self._before.items():
            signal.signal(number, handler)
        if self._before:
            signal.set_wakeup_fd(self._wakeup_before)
        os.close(self.fd)
        os.close(self._write_fd)

    def _count(self, _number: int, _frame: FrameType | None) -> None:
        self.count += 1
