"""Frames that somebody else asks for while a run goes on. Rule: `request` and `end` may be called by any
thread; answers come on the thread of the run, in the order of the frames that were presented.
"""

from __future__ import annotations

import contextlib
import os
import threading
from collections import deque
from collections.abc import Callable, Mapping

from trilane.scheduler.events import Event, FrameRequest, Stop


class FrameRequestQueue:
    """The way into one run. Frames are numbered from 0 as they are asked for.

    `answered(frame)`: it was presented. `ended()`: the run is over, and nothing more is answered.
    `unanswered(causes)`: frames were dropped or lost, how many by each cause's key in the report; called once, with the
    first of them.
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
        """No more is asked for; what was asked for is finished."""
        self._put(Stop())

    def events(self) -> list[Event]:
        """What was requested since the last call."""
        events: list[Event] = []
        with contextlib.suppress(IndexError):
            while True:
                events.append(self._events.popleft())
        return events

    def tell_unanswered(self, causes: Mapping[str, int]) -> None:
        """By the run: so many frames were dropped or lost so far, by cause."""
        if causes and not self._told:
            self._told = True
            self._unanswered(causes)

    def close(self) -> None:
        """The run is over: `ended` is called, whoever waits for `is_open` goes on."""
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
