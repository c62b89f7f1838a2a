"""Passes on frames that somebody asks for during a run.

Rule: any thread may call `request` and `end`. Answers come on the thread of the run, in the order in which the frames
were presented.
"""

from __future__ import annotations

import contextlib
import os
import threading
from collections import deque
from collections.abc import Callable, Mapping

from trilane.scheduler.events import Event, FrameRequest, Stop


class FrameRequestQueue:
    """The way into one run; frames are numbered from 0 in the order in which they are asked for.

    `answered(frame)`: function that is called when the frame was presented.
    `ended()`: function that is called when the run is over, after which nothing is answered.
    `unanswered(causes)`: function that is called once, with the first frames that were dropped or lost: their number by
    each cause's key in the report.
    """

    def __init__(
        self,
        answered: Callable[[int], None],
        ended: Callable[[], None],
        unanswered: Callable[[Mapping[str, int]], None] = lambda _causes: None,
    ) -> None:
        self.fd = os.eventfd(0, os.EFD_NONBLOCK | os.EFD_CLOEXEC)
        self.is_open = threading.Event()
        self.answered, self._ended, self._unanswered = answered, ended, unanswered
        self._told = False
        self._events: deque[Event] = deque()
        self._lock = threading.Lock()
        self._closed = False

    def request(self, count: int = 1) -> None:
        """Ask for `count` frames; once the run is over this does nothing."""
        self._put(FrameRequest(count))

    def end(self) -> None:
        """Ask for no more frames; those that were asked for are finished."""
        self._put(Stop())

    def events(self) -> list[Event]:
        """Return what was requested since the last call."""
        events: list[Event] = []
        with contextlib.suppress(IndexError):
            while True:
                events.append(self._events.popleft())
        return events

    def tell_unanswered(self, causes: Mapping[str, int]) -> None:
        """Tell the caller how many frames were dropped or lost so far, by cause; called by the run."""
        if causes and not self._told:
            self._told = True
            self._unanswered(causes)

    def close(self) -> None:
        """Note that the run is over: call `ended`, and let whoever waits for `is_open` go on."""
        with self._lock:
            if self._closed:
                return
            self._closed = True
            os.close(self.fd)
        self._ended()
        self.is_open.set()

    def _put(self, event: Event) -> None:
        with self._lock:
            if not self._closed:
                self._events.append(event)
                os.eventfd_write(self.fd, 1)
