"""The frames of a run as tracks: when each was to be presented, when it was, and those that were lost or dropped.

Rule: a frame is late by the measure by which the report counts missed deadlines: past its deadline, or, where frames
have none, longer after the frame before than the scene's rate allows.
"""

from __future__ import annotations

from typing import Final

from trilane.apps.tracing.sink import Sink
from trilane.apps.tracing.tiles import Lanes
from trilane.pipeline.journal import Begun
from trilane.pipeline.timeline import UNKNOWN, Gone, Presented
from trilane.scheduler.events import NEVER

NS_PER_US: Final = 1000
MOST_LANES: Final = 32
EXPECTED, ACTUAL, LEFT_OUT, IN_FLIGHT = "Expected frames", "Actual frames", "Lost and dropped", "Frames in flight"


class FrameTracks:
    """Tracks below `parent`, from `rank` on. `add` is called with each frame that has left the pipeline."""

    def __init__(self, sink: Sink, begun: Begun, parent: int, rank: int) -> None:
        self._sink, self._parent = sink, parent
        self._deadline_ns = begun.settings.deadline_ns
        self._target_ns = 0 if self._deadline_ns else target_period_ns(begun)
        self._ranks = {EXPECTED: rank, ACTUAL: rank + 1}
        self._lanes = {name: Lanes(MOST_LANES) for name in self._ranks}
        self._tracks: dict[tuple[str, int], int] = {}
        self._left_out = sink.track(LEFT_OUT, parent, rank + 2)
        self._in_flight = sink.counter_track(IN_FLIGHT, parent, rank + 3)
        self._flying = -1
        self._before_ns: int | None = None

    def add(self, frame: Presented | Gone) -> None:
        """A frame that was presented, lost or dropped."""
        if isinstance(frame, Gone):
            if frame.frame != UNKNOWN:
                self._expect(frame.frame, frame.release_ns)
            notes = {"frame": frame.frame} if frame.frame != UNKNOWN else {}
            self._sink.instant(self._left_out, frame.at_ns, f"{frame.kind} {frame.cause}", notes)
            return
        due_ns = self._expect(frame.frame, frame.release_ns)
        late_ns = frame.end_ns - due_ns
        name = f"late {frame.frame}" if late_ns > 0 else f"{frame.frame}"
        notes = {"late_us": late_ns // NS_PER_US} if late_ns > 0 else {}
        self._slice(ACTUAL, frame.release_ns, frame.end_ns, name, notes)
        self._before_ns = frame.end_ns

    def count(self, at_ns: int, in_flight: int) -> None:
        """How many frames are in flight."""
        if in_flight != self._flying:
            self._flying = in_flight
            self._sink.count(self._in_flight, at_ns, self._flying)

    def _expect(self, frame: int, release_ns: int) -> int:
        """Show when the frame was to be presented; the time by which, NEVER where none is expected."""
        if self._deadline_ns:
            begin_ns, due_ns = release_ns, release_ns + self._deadline_ns
        elif self._target_ns and self._before_ns is not None:
            begin_ns, due_ns = self._before_ns, self._before_ns + self._target_ns
        else:
            return NEVER
        self._slice(EXPECTED, begin_ns, due_ns, f"{frame}", {})
        return due_ns

    def _slice(self, name: str, begin_ns: int, end_ns: int, text: str, notes: dict[str, int]) -> None:
        lane, begin_ns = self._lanes[name].place(begin_ns, end_ns)
        if (name, lane) not in self._tracks:
            self._tracks[name, lane] = self._sink.track(name, self._parent, self._ranks[name])
        self._sink.slice(self._tracks[name, lane], begin_ns, end_ns, text, notes)


def target_period_ns(begun: Begun) -> int:
    """The frame time for which the scene of a run is meant, 0 where the journal says none."""
    scene = begun.facts.get("config", {}).get("scene", {})
    fps = scene.get("fps") if isinstance(scene, dict) else None
    return round(1e9 / fps) if isinstance(fps, int | float) and fps > 0 else 0
