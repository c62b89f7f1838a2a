"""What somebody asks of a run while it goes on. Rule: any thread may ask; the run does it between two of its steps.

A request becomes an event of the scheduler, so the recording holds it and a replay does the same. A kill becomes an
event when the unit's end is heard.
"""

from __future__ import annotations

import os
import threading

from trilane.scheduler.events import Event, Hold, Stop

ALL = -1


class RunControls:
    """The way into one run; once the run is over, requests do nothing."""

    def __init__(self) -> None:
        self.fd = os.eventfd(0, os.EFD_NONBLOCK | os.EFD_CLOEXEC)
        self._events: list[Event] = []
        self._kills: list[str] = []
        self._lock = threading.Lock()
        self._closed = False

    def hold(self, frames: int) -> None:
        """Release `frames` more frames and then none; `ALL` ends the hold."""
        self._ask(Hold(frames))

    def stop(self) -> None:
        """Finish the frames in flight, and end the run."""
        self._ask(Stop())

    def kill(self, unit: str) -> None:
        """End the unit's process at once; the scheduler starts it again."""
        with self._lock:
            if not self._closed:
                self._kills.append(unit)
                os.eventfd_write(self.fd, 1)

    def taken(self) -> tuple[list[Event], list[str]]:
        """Return the events and the units to kill that were asked for since the last call; called by the run."""
        with self._lock:
            taken = self._events, self._kills
            self._events, self._kills = [], []
            return taken

    def close(self) -> None:
        """Note that the run is over; called by the run."""
        with self._lock:
            if not self._closed:
                self._closed = True
                os.close(self.fd)

    def _ask(self, event: Event) -> None:
        with self._lock:
            if not self._closed:
                self._events.append(event)
                os.eventfd_write(self.fd, 1)
