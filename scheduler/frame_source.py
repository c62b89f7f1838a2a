"""Releases frames and queues them within limits. Rule: each frame leaves here once, or is counted."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable

from trilane.scheduler.events import NEVER, DropCause, Settings


class Source:
    """The source of frames 0..n-1. A released frame waits in `queue` until it is taken, turned away, or out of time.

    Without a rate (no period, no arrivals, no requests) a frame counts as released at the moment when it can be taken.
    While frames are held, `hold` alone releases them, a few at a time. After the hold the next frame is due at once,
    and the frames after it follow at their usual distances.

    `drop`: function that is called with each frame that is dropped here, its release time and the cause.
    `due_ns`: time at which the next frame is released or the oldest waiting frame runs out of time.
    `is_empty`: whether no frame can be taken now.
    """

    def __init__(self, settings: Settings, drop: Callable[[int, int, DropCause], None]) -> None:
        self._settings = settings
        self._drop = drop
        self._next = 0
        self._end = settings.frames
        self._start_ns = 0
        self._paced = bool(settings.period_ns or settings.arrivals_ns or settings.asked)
        self._held = False
        self._forgotten = 0
        self.queue: deque[tuple[int, int]] = deque()
        self.due_ns = NEVER
        self.is_empty = self._paced or not self._end  # with a rate, no frame is released before `start`

    @property
    def _waits(self) -> bool:
        """Whether a frame must be released before it can be taken."""
        return self._paced or self._held

    def start(self, now_ns: int) -> None:
        """Begin the run: periods and arrivals count from `now_ns`."""
        self._start_ns = now_ns
        self._set_due()

    def stop(self) -> None:
        """Release nothing more, and forget the waiting frames."""
        self._end = self._next
        self._forgotten += len(self.queue)
        self.queue.clear()
        self._set_due()

    @property
    def released(self) -> int:
        """The number of frames released so far: those that have left, those that wait, and those that `stop` forgot."""
        return self._next

    @property
    def left(self) -> int:
        """The number of frames that were taken or dropped here."""
        return self._next - self._forgotten - len(self.queue)

    @property
    def exhausted(self) -> bool:
        return self._next >= self._end and not self.queue

    def advance(self, now_ns: int) -> bool:
        """Release the frames that are due, drop those that waited too long, and return whether something changed."""
        changed = False
        while self._paced and not self._held and self._next < self._end:
            release_ns = self._release_ns(self._next)
            if release_ns > now_ns:
                break
            self._admit(self._next, release_ns)
            self._next += 1
            changed = True
        timeout = self._settings.queue_timeout_ns
        while timeout and self.queue and self.queue[0][1] + timeout <= now_ns:
            self._drop(*self.queue.popleft(), DropCause.TIMEOUT)
            changed = True
        self._set_due()
        return changed

    def request(self, count: int, now_ns: int) -> None:
        """Release `count` frames, or all that are left if they are fewer."""
        for frame in range(self._next, min(self._next + count, self._end)):
            self._admit(frame, now_ns)
            self._next += 1
        self._set_due()

    def hold(self, frames: int, now_ns: int) -> None:
        """Release `frames` frames and no more until the next call; -1 ends the hold."""
        if frames >= 0:
            self._held = True
            self.request(frames, now_ns)
        elif self._held:
            self._held = False
            if self._paced and not self._settings.asked and self._next < self._end:
                # The schedule is moved on, so that the frames that came due in the hold are not all released at its
                # end.
                self._start_ns += now_ns - self._release_ns(self._next)
            self._set_due()

    def head(self, now_ns: int) -> tuple[int, int]:
        """Return the next frame and its release time; only valid if `is_empty` is False."""
        return self.queue[0] if self.queue else (self._next, now_ns)

    def keep_newest(self) -> None:
        """Drop all waiting frames but the newest, as stale."""
        while len(self.queue) > 1:
            self._drop(*self.queue.popleft(), DropCause.STALE)
        self._set_due()

    def drop_late_head(self) -> None:
        """Drop the frame that has waited longest, as it cannot be in time."""
        self._drop(*self.queue.popleft(), DropCause.LATE)
        self._set_due()

    def take(self, now_ns: int) -> tuple[int, int]:
        """Remove the head, and return it with its release time."""
        head = self.head(now_ns)
        if self.queue:
            self.queue.popleft()
        else:
            self._next += 1
        self._set_due()
        return head

    def _admit(self, frame: int, release_ns: int) -> None:
        limit = self._settings.in_queue
        if limit and len(self.queue) >= limit:
            self._drop(frame, release_ns, DropCause.QUEUE_FULL)
        else:
            self.queue.append((frame, release_ns))

    def _set_due(self) -> None:
        self.is_empty = not self.queue and (self._waits or self._next >= self._end)
        is_timed = self._paced and not self._held and self._next < self._end
        self.due_ns = self._release_ns(self._next) if is_timed else NEVER
        if self._settings.queue_timeout_ns and self.queue:
            self.due_ns = min(self.due_ns, self.queue[0][1] + self._settings.queue_timeout_ns)

    def _release_ns(self, frame: int) -> int:
        # Requests alone release frames.
        if self._settings.asked:
            return NEVER
        arrivals = self._settings.arrivals_ns
        return self._start_ns + (arrivals[frame] if arrivals else frame * self._settings.period_ns)
