"""Which way is up in a camera recording, and how its device was held: every axis of the world with every quarter turn.

Rule: people hold a camera level. A pair of an axis and a quarter turn of the picture is dear by how far the picture's
horizon is from level, by how steeply the camera would look down or up and how much that would change, by an axis that
is not the usual one of the format, and by a turned picture; the cheapest pair is taken, and a near rival with another
picture is named. Where no axis fits, and the pictures' horizons agree on a direction between the axes, that is up.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from trilane.arrays import F64

AUTO = "auto"
UP: dict[str, tuple[float, float, float]] = {
    "y": (0.0, 1.0, 0.0),
    "z": (0.0, 0.0, 1.0),
    "-y": (0.0, -1.0, 0.0),
    "x": (1.0, 0.0, 0.0),
    "-z": (0.0, 0.0, -1.0),
    "-x": (-1.0, 0.0, 0.0),
}
#: The mean cosine of a picture's up with the world's must be above this.
LEAST_UP_COSINE = 0.3
#: What a horizon is dear that is off by a radian (root mean square), a line of sight that goes up and down by a radian
#: (standard deviation; people turn round, but seldom look up and down), and one that is never level.
PER_ROLL, PER_TILT, PER_PITCH = 2.0, 1.0, 0.5


@dataclass(frozen=True)
class _Prices:
    """Of another axis than the usual one, of a turned picture, and of a direction that is no axis (None: never)."""

    axis: float
    turn: float
    between: float | None


#: Of a format whose world is whatever the program chose, and of one whose world is aligned with gravity by definition.
#: In the first a turn of the device is believed after every axis: it costs what another axis costs, and what the
#: picture's own up can be off an axis (45 degrees) besides.
ANY_WORLD, LEVELLED = _Prices(0.2, 0.4, 0.25), _Prices(0.4, 0.1, None)
#: A direction between the axes is believed when the cameras pan by this, in radians (root mean square), and it is
#: farther than this cosine from every axis.
LEAST_PAN, MOST_AXIS_COSINE = 0.15, 0.995
#: Cosine above which the first picture's axes, OpenGL's or optical ones, are the world's; and what is said then, as
#: nothing else tells it.
AS_FIRST = 1 - 1e-8
OF_FIRST = "; the axes are those of the first picture: if that looked down or up, the floor is tilted by as much"
#: A rival this much dearer than the best is named.
NEAR = 0.1


@dataclass(frozen=True)
class Upright:
    """`up` (3,): the world's, of unit length. `quarter`: how many times the picture is turned by 90 degrees."""

    up: F64
    quarter: int
    note: str


@dataclass(frozen=True)
class _Guess:
    name: str
    up: F64
    quarter: int
    price: float


def upright(turns: F64, usual: str, is_levelled: bool, stated: str = AUTO) -> Upright:
    """Up of a world, and the quarter turns of the picture, of cameras with axes `turns` (N, 3, 3), camera to world.

    `usual`: the axis that is up in the format. `is_levelled`: whether the format's world is aligned with gravity by
    definition. `stated`: what the scene says is up; only turns of the picture are tried then.
    """
    expected = usual if stated == AUTO else stated
    guesses = _guesses(turns, expected, LEVELLED if is_levelled else ANY_WORLD, stated)
    if not guesses:
        return Upright(np.array(UP[expected]), 0, f"{expected.upper()} up, {_why_without(stated)}")
    best = min(guesses, key=lambda guess: guess.price)
    of_first = OF_FIRST if best.name and not is_levelled and _is_of_first(turns, best) else ""
    return Upright(best.up, best.quarter, _note(best, usual, stated) + _rival(best, guesses, stated) + of_first)


def price_of(turns: F64, usual: str) -> float:
    """How dear the cheapest guess is of cameras with axes `turns` (N, 3, 3): 0 where they are level as is `usual`."""
    return min((guess.price for guess in _guesses(turns, usual, ANY_WORLD, AUTO)), default=math.inf)


def _guesses(turns: F64, expected: str, prices: _Prices, stated: str) -> list[_Guess]:
    axes = UP if stated == AUTO else {stated: UP[stated]}
    guesses = [
        _Guess(name, np.array(up), quarter, price + (name != expected) * prices.axis + (quarter > 0) * prices.turn)
        for name, up in axes.items()
        for quarter in range(4)
        if (price := _price(turns, np.array(up), quarter)) is not None
    ]
    if stated != AUTO or prices.between is None:
        return guesses
    return guesses + _between(turns, prices.between)


def _is_of_first(turns: F64, best: _Guess) -> bool:
    """Whether the world's axes are those of the first of several pictures, as in a SLAM map, and up is its own up."""
    first = turns[0]
    is_unturned = abs(first[0, 0]) > AS_FIRST and abs(first[1, 1]) > AS_FIRST
    return len(turns) > 1 and bool(is_unturned and first[0, 0] > 0 and first[:, 1] @ best.up > AS_FIRST)


def _why_without(stated: str) -> str:
    return "as given" if stated != AUTO else "usual for the format; the pictures show no horizon to tell it by"


def _ups_and_rights(turns: F64, quarter: int) -> tuple[F64, F64]:
    """Up and right (N, 3) of pictures that are turned by `quarter` times 90 degrees."""
    x, y = turns[:, :, 0], turns[:, :, 1]
    return ((y, x), (-x, y), (-y, -x), (x, -y))[quarter]


def _price(turns: F64, up: F64, quarter: int) -> float | None:
    """What level horizons and level sight say against a pair; None when the picture's up is not up at all."""
    ups, rights = _ups_and_rights(turns, quarter)
    cosine = float((ups @ up).mean())
    if cosine <= LEAST_UP_COSINE:
        return None
    roll, tilt = float(np.sqrt(np.mean((rights @ up) ** 2))), float(np.std(turns[:, :, 2] @ up))
    return PER_ROLL * roll + PER_TILT * tilt + PER_PITCH * (1.0 - cosine)


def _between(turns: F64, dearer: float) -> list[_Guess]:
    """The direction to which the horizons of all pictures are level, most nearly: at right angles to their rights."""
    ups, rights = _ups_and_rights(turns, 0)
    spread, directions = np.linalg.eigh(rights.T @ rights / len(rights))
    direction = directions[:, 0] if (ups @ directions[:, 0]).mean() >= 0 else -directions[:, 0]
    if spread[1] < LEAST_PAN**2 or np.abs(direction).max() > MOST_AXIS_COSINE:
        return []
    price = _price(turns, direction, 0)
    return [] if price is None else [_Guess("", direction, 0, price + dearer)]


def _note(best: _Guess, usual: str, stated: str) -> str:
    turned = f", device held so that the picture is turned by {best.quarter * 90} degrees" if best.quarter else ""
    if not best.name:
        nearest = max(UP, key=lambda name: float(best.up @ UP[name]))
        off = np.degrees(np.arccos(np.clip(best.up @ UP[nearest], -1, 1)))
        return f"up is {off:.0f} degrees off {nearest.upper()}, where the pictures' horizons are level"
    if stated != AUTO:
        return f"{best.name.upper()} up, as given{turned}"
    if best.name != usual:
        return f"{best.name.upper()} up, as the camera is held (not {usual.upper()}, usual for the format){turned}"
    return f"{best.name.upper()} up{turned}"


def _rival(best: _Guess, guesses: list[_Guess], stated: str) -> str:
    """The next guess, when it is nearly as cheap and the two are far apart."""
    rivals = [g for g in guesses if g.name and g is not best and g.price < best.price + NEAR]
    rivals = [g for g in rivals if g.quarter != best.quarter or g.up @ best.up < np.sqrt(0.5)]
    if not rivals or stated != AUTO:
        return ""
    rival = min(rivals, key=lambda guess: guess.price)
    turned = f" with the picture turned by {rival.quarter * 90} degrees" if rival.quarter else ""
    return f"; {rival.name.upper()} up{turned} fits nearly as well: camera.up_axis decides"
