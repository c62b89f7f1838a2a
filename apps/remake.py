"""What of an avatar a run may ask to be made anew: the network's width and calibration, the texture's channels.

Rule: pure, and imports nothing that takes long; `remade_avatar` makes it.
"""

from __future__ import annotations

from dataclasses import dataclass

from trilane.errors import BadInputError, did_you_mean

#: The calibration of the network in the avatar's own file.
AS_IT_IS = "as-it-is"
#: As `trilane.training.quantising.calibration` has them, which takes long to import.
METHODS = ("minmax", "percentile", "entropy")
#: Of an untrained network that nobody asks a calibration of, and how many views where no number is given.
METHOD, VIEWS = "minmax", 5
MOST_VIEWS = 1000
MOST_WIDTH = 256
#: That the packed pass draws (`stages/gpu/packed_pass.py`).
CHANNELS = (4, 8, 12, 16)


@dataclass(frozen=True)
class Remake:
    """What is made anew; None as the avatar has it.

    `width`: of the network, 64 is full. `channels`: of the neural texture. `calibration`: METHOD or METHOD:VIEWS.
    """

    width: int | None = None
    channels: int | None = None
    calibration: str | None = None

    @property
    def is_asked(self) -> bool:
        return any(value not in (None, AS_IT_IS) for value in (self.width, self.channels, self.calibration))


def check_remake(remake: Remake) -> None:
    """Raises BadInputError for a width, a number of channels or a calibration that there is none of."""
    width, channels = remake.width, remake.channels
    if width is not None and (type(width) is not int or not 1 <= width <= MOST_WIDTH):
        raise BadInputError("--width", repr(width), f"a whole number from 1 to {MOST_WIDTH}")
    if channels is not None and (type(channels) is not int or channels not in CHANNELS):
        raise BadInputError("--channels", repr(channels), "4, 8, 12 or 16")
    if remake.calibration is not None:
        calibration_of(remake.calibration)


def calibration_of(text: str) -> tuple[str, int] | None:
    """Method and number of views of `text`, METHOD or METHOD:VIEWS; None of `AS_IT_IS`. Raises BadInputError."""
    method, colon, views = text.partition(":")
    if text == AS_IT_IS:
        return None
    if method not in METHODS:
        known = (AS_IT_IS, *METHODS)
        raise BadInputError("--calibration", repr(text), f"one of {', '.join(known)}", did_you_mean(method, known))
    if colon and not (views.isdecimal() and len(views) < 5 and 1 <= int(views) <= MOST_VIEWS):
        raise BadInputError("--calibration", repr(text), f"{method} or {method}:VIEWS, VIEWS from 1 to {MOST_VIEWS}")
    return method, int(views) if colon else VIEWS
