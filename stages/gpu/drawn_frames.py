"""Which frame each output slot of the composite still holds. Rule: a slot holds what was put there last.

Only the composite writes to its output slots, so their bytes stay until it writes there again, whoever reads them.
"""

from __future__ import annotations

#: Picture of the avatars, picture of the background, view and projection.
Drawing = tuple[int, int, bytes, bytes]


class DrawnFrames:
    """Notes of what was drawn, by slot."""

    def __init__(self) -> None:
        self._slots: dict[int, tuple[Drawing | None, int]] = {}

    def slot_of(self, drawing: Drawing | None, preferred: int) -> int | None:
        """A slot that holds `drawing`, `preferred` if that does; None when there is none, or `drawing` is None."""
        if drawing is None:
            return None
        held = [slot for slot, (there, _) in self._slots.items() if there == drawing]
        return preferred if preferred in held else held[0] if held else None

    def note(self, slot: int, drawing: Drawing | None, frame: int, copied_from: int | None) -> int:
        """`slot` holds `drawing` of `frame` from now on; what `repeats` of the frame's header is to be.

        `copied_from`: the slot that held it already; None when it was drawn now.
        """
        drawn = frame if copied_from is None else self._slots[copied_from][1]
        self._slots[slot] = (drawing, drawn)
        return 0 if copied_from is None else drawn + 1
