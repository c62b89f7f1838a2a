"""Requests to a live run: controls, frame requests, and signals.

Rule: any thread may send a request; the run handles it between two of its steps, on the run's thread. A signal handler
only counts the signal.

A request becomes an event of the scheduler, so that the recording contains it and a replay repeats it. A request to
kill a unit becomes an event when the run notices the end of the unit's process. Requested frames are answered in the
order in which they are presented.
"""

from __future__ import annotations

import os
import signal
import threading
from collections.abc import Callable, Mapping
from types import FrameType
from typing import Any, Generic, Self, TypeVar

from trilane.scheduler.events import Event, FrameRequest, Hold, Stop
from trilane.signals import that_end

ALL = -1


Request = TypeVar("Request")


class _Requests(Generic[Request]):
    """Requests of any thread to one run; once the run is over, a request does nothing.

    `fd`: descriptor that becomes readable with each request.
    """

    def __init__(self) -> None:
        self.fd = os.eventfd(0, os.EFD_NONBLOCK | os.EFD_CLOEXEC)
        self._waiting: list[Request] = []
        self._lock = threading.Lock()
        self._closed = False

    def _put(self, request: Request) -> None:
        with self._lock:
            if not self._closed:
                self._waiting.append(request)
                os.eventfd_write(self.fd, 1)

    def _take(self) -> list[Request]:
        count = len(self._waiting)  # no lock: the scheduler waits for no requester, and appends come behind
        taken = self._waiting[:count]
        del self._waiting[:count]
        return taken

    def _close(self) -> bool:
        """Note that the run is over. Return whether this is the first call."""
        with self._lock:
            if self._closed:
                return False
            self._closed = True
            os.close(self.fd)
        return True


class RunControls(_Requests[Event | str]):
    """Passes requests to one run: hold, stop, kill a unit. Once the run is over, requests do nothing."""

    def hold(self, frames: int) -> None:
        """Release `frames` more frames now, and no others until the next call; `ALL` ends the hold."""
        self._put(Hold(frames))

    def stop(self) -> None:
        """Finish the frames in flight, and end the run."""
        self._put(Stop())

    def kill(self, unit: str) -> None:
        """End the process of `unit` at once; the scheduler starts the unit again."""
        self._put(unit)

    def taken(self) -> tuple[list[Event], list[str]]:
        """Return (requested events, names of units to kill) since the last call; called by the run."""
        taken = self._take()
        return [each for each in taken if not isinstance(each, str)], [each for each in taken if isinstance(each, str)]

    def close(self) -> None:
        """Note that the run is over; called by the run."""
        self._close()


class FrameRequestQueue(_Requests[Event]):
    """Passes frame requests to one run; frames are numbered from 0 in the order of the requests.

    `answered(frame)`: function that is called with the number of each presented frame.
    `ended()`: function that is called when the run is over; after it `answered` is not called any more.
    `unanswered(causes)`: function that is called once, when the first frames were dropped or lost. `causes`: number of
    these frames by the cause's key in the report.
    `is_open`: `threading.Event` that is set when the run begins to take requests, and also when the run is over.
    """

    def __init__(
        self,
        answered: Callable[[int], None],
        ended: Callable[[], None],
        unanswered: Callable[[Mapping[str, int]], None] = lambda _causes: None,
    ) -> None:
        super().__init__()
        self.is_open = threading.Event()
        self.answered, self._ended, self._unanswered = answered, ended, unanswered
        self._told = False

    def request(self, count: int = 1) -> None:
        """Ask for `count` frames; once the run is over, do nothing."""
        self._put(FrameRequest(count))

    def end(self) -> None:
        """Ask for no more frames; the requested frames are finished."""
        self._put(Stop())

    def events(self) -> list[Event]:
        """Return the requests since the last call, as events of the scheduler."""
        return self._take()

    def tell_unanswered(self, causes: Mapping[str, int]) -> None:
        """Call `unanswered` the first time that there are dropped or lost frames. `causes`: their number by cause."""
        if causes and not self._told:
            self._told = True
            self._unanswered(causes)

    def close(self) -> None:
        """Note that the run is over: call `ended`, and set `is_open`, so that no thread waits any longer."""
        if self._close():
            self._ended()
            self.is_open.set()


class Interrupts:
    """Context manager that counts signals, and makes `fd` readable at each signal.

    It does nothing outside the main thread. Within the context SIGPIPE is ignored: a message to a unit that is gone
    must not end the program.

    `fd`: descriptor that becomes readable.
    `count`: number of signals so far that end a run.
    `last`: the last of the signals that `count` counts.
    `continued`: number of times that this process went on after a signal had stopped it.
    """

    def __init__(self) -> None:
        self.count = self.continued = 0
        self.last = signal.SIGINT
        self.fd, self._write_fd = os.pipe2(os.O_NONBLOCK | os.O_CLOEXEC)
        self._before: dict[int, Any] = {}
        self._wakeup_before = -1

    def __enter__(self) -> Self:
        if threading.current_thread() is threading.main_thread():
            self._wakeup_before = signal.set_wakeup_fd(self._write_fd, warn_on_full_buffer=False)
            for number in that_end():
                self._before[number] = signal.signal(number, self._count)
            self._before[signal.SIGCONT] = signal.signal(signal.SIGCONT, self._continue)
            self._before[signal.SIGPIPE] = signal.signal(signal.SIGPIPE, signal.SIG_IGN)
        return self

    def __exit__(self, *_exc: object) -> None:
        for number, handler in self._before.items():
            signal.signal(number, handler)
        if self._before:
            signal.set_wakeup_fd(self._wakeup_before)
        os.close(self.fd)
        os.close(self._write_fd)

    def _count(self, number: int, _frame: FrameType | None) -> None:
        self.count += 1
        self.last = signal.Signals(number)

    def _continue(self, _number: int, _frame: FrameType | None) -> None:
        self.continued += 1
