"""Turns a recorded camera into a CameraPath: finds the unit of the map, its up, and how the device was held.

The movement from pose to pose never changes. Three constants are applied. A rotation of the world makes +Y up. A
rotation of the picture by a multiple of 90 degrees does what a phone does with its display. A scale converts to metres.

**Unit.** The scene states the unit, or the format defines it as a metre. Otherwise the scale may be guessed: a person
fills the pictures where the cameras look. A format without a unit is always guessed. A format that usually has metres
is guessed if the camera would be faster than anything that carries a camera. Files of NeRF have no unit, but many are
in metres. They are guessed if the camera is too fast, or if the views circle a point at which no person fits.

**Up.** People hold a camera level. Each axis of the world is tried with each quarter turn of the picture. A guess costs
more if the horizon is far from level, if the camera looks steeply down or up, or if this elevation changes. A guess
also costs more if the axis is not the format's usual one, or if the picture is turned. The cheapest guess wins; if
another guess is nearly as cheap, a note names it. If no axis fits, and the horizons agree on a direction between the
axes, that direction is up.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from enum import Enum

import numpy as np
from numpy.typing import NDArray

from trilane.arrays import F64
from trilane.errors import BadInputError
from trilane.scene.camera.path import CameraPath, Optics, one_lens
from trilane.scene.lens import Lens
from trilane.scene.recordings import NOTHING, Detected, PlaceOf, by_number, usable_samples
from trilane.scene.rotations import about, quat_from_matrix, shortest_turn
from trilane.scene.schema import CameraSpec

#: If the median position is farther from the origin than this, metres, all positions are moved. Beyond it, float32 no
#: longer resolves tenths of a millimetre.
MAP_M = 1e3
#: Median speed, units per second, above which the unit of a map cannot be a metre.
FASTEST_M_S = 40.0
#: Height of a person, metres, and the share of the picture's height that a person fills at the point where the cameras
#: look.
PERSON_M, SHARE = 1.7, 0.75
#: Least eigenvalue of the mean projection matrix (1 - d d'); below it, the lines of sight are nearly parallel and meet
#: nowhere.
LEAST_SPREAD = 0.02
#: Extent, metres, of the path of a camera that looks at no particular point.
PATH_M = 2.0


class LengthUnit(Enum):
    """The unit of a format's lengths.

    METRES: metres by definition. USUALLY_M: metres, unless the camera is too fast. OFTEN_M: metres, if a person fits
    into the pictures. NONE: no unit.
    """

    METRES = "metres"
    USUALLY_M = "usually metres"
    OFTEN_M = "often metres"
    NONE = "none"


def near_origin(places: F64) -> tuple[F64, tuple[str, ...]]:
    """Return (`places` (N, 3) without the large offset that maps such as UTM have; a note on the offset, or ())."""
    finite = np.isfinite(places).all(axis=1)
    middle = np.median(places[finite], axis=0) if finite.any() else np.zeros(3)
    if np.abs(middle).max() <= MAP_M:
        return places, ()
    offset = np.round(middle)
    text = ", ".join(f"{value:.0f}" for value in offset)
    return places - offset, (f"origin of the map moved: ({text}) subtracted from all places",)


def metres_per_unit(
    turns: F64, places: F64, times_s: F64, fov_y_deg: float, unit: LengthUnit, spec: CameraSpec
) -> tuple[float, tuple[str, ...]]:
    """Return (number of metres per unit of the map, notes on this number).

    `turns` (N, 3, 3), `places` (N, 3): camera to world, OpenGL axes.
    `times_s` (N,): times.
    `fov_y_deg`: field of view over the picture's height, degrees.
    `unit`: unit of the format.
    `spec`: camera of the scene.
    """
    if spec.metres_per_unit is not None:
        return spec.metres_per_unit, (f"1 unit of the file is {spec.metres_per_unit:g} m, as given",)
    speed = _speed(places, times_s)
    is_possible = unit is not LengthUnit.NONE and speed <= FASTEST_M_S
    if unit is LengthUnit.METRES or (unit is LengthUnit.USUALLY_M and is_possible):
        return 1.0, ()
    reason = f"at {speed:.0f} m/s its unit can be no metre"
    if unit is LengthUnit.NONE or is_possible:
        reason = "the file has no unit"
    if unit is LengthUnit.OFTEN_M and is_possible:
        height = _looked_at_height(turns, places, fov_y_deg)
        if height is None or height >= PERSON_M:
            return 1.0, (f"{reason}: 1 unit is taken for 1 m; camera.metres_per_unit decides",)
        reason += ", and in metres no person would fit where the cameras look"
    if spec.place == "none":
        return 1.0, (f"{reason}: 1 unit is taken for 1 m, as camera.place is none; camera.metres_per_unit decides",)
    scale, how = _fitting(turns, places, fov_y_deg)
    return scale, (f"{reason}: 1 unit is taken for {scale:.4g} m, so that {how}; camera.metres_per_unit decides",)


def _looked_at_height(turns: F64, places: F64, fov_y_deg: float) -> float | None:
    """Return the height, in units of the map, that the pictures show at the point where the cameras look."""
    distance = looked_at_from(turns, places)
    return None if distance is None else float(2 * np.tan(np.radians(fov_y_deg) / 2) * distance)


def _speed(places: F64, times_s: F64) -> float:
    """Return the median speed between `places` (N, 3) at `times_s` (N,), units per second; 0 for a single position."""
    if len(places) < 2:
        return 0.0
    return float(np.median(np.linalg.norm(np.diff(places, axis=0), axis=1) / np.diff(times_s)))


def _fitting(turns: F64, places: F64, fov_y_deg: float) -> tuple[float, str]:
    """Return (metres per unit of the map, reason in words), from the path's shape and the lines of sight alone."""
    height = _looked_at_height(turns, places, fov_y_deg)
    if height is not None:
        return PERSON_M / SHARE / height, f"a person fills {SHARE:.0%} of the picture's height where the cameras look"
    length = float(np.linalg.norm(places.max(axis=0) - places.min(axis=0)))
    if length == 0.0:
        return 1.0, "nothing changes, as the camera stays where it is"
    return PATH_M / length, f"the path is {PATH_M:g} m from end to end"


def looked_at_from(turns: F64, places: F64) -> float | None:
    """Return the median distance of the cameras from the point nearest to all lines of sight, in units of `places`.

    The result is None if the lines are nearly parallel, or if they meet behind the cameras.
    """
    point = meeting_point(turns, places)
    if point is None:
        return None
    towards = point - places
    distance = float(np.median(np.linalg.norm(towards, axis=1)))
    in_front = float(np.median(-(towards * turns[:, :, 2]).sum(axis=1)))
    return distance if in_front > 0.5 * distance > 0 else None


def meeting_point(turns: F64, places: F64) -> F64 | None:
    """Return the point (3,) nearest to all lines of sight, ahead of the cameras or behind; None for parallel lines.

    `turns` (N, 3, 3), `places` (N, 3): camera to world, OpenGL axes.

    The point x solves the normal equations of the distances: sum (1 - d d') (x - p) = 0 for positions p and unit
    directions d.
    """
    ahead = -turns[:, :, 2]
    across = np.eye(3) - ahead[:, :, None] * ahead[:, None, :]
    if np.linalg.eigvalsh(across.mean(axis=0))[0] < LEAST_SPREAD:
        return None
    return np.asarray(np.linalg.solve(across.sum(axis=0), (across @ places[:, :, None]).sum(axis=0)[:, 0]))


AUTO = "auto"
#: Units of lengths that column names may state, in metres; relative difference within which the scene's unit is the
#: same.
LENGTH_UNITS = {"m": 1.0, "cm": 0.01, "mm": 0.001, "km": 1000.0, "ft": 0.3048, "in": 0.0254}
SAME_UNIT = 1e-3
UP: dict[str, tuple[float, float, float]] = {
    "y": (0.0, 1.0, 0.0),
    "z": (0.0, 0.0, 1.0),
    "-y": (0.0, -1.0, 0.0),
    "x": (1.0, 0.0, 0.0),
    "-z": (0.0, 0.0, -1.0),
    "-x": (-1.0, 0.0, 0.0),
}
#: A picture's up is up in the world only if their mean cosine is above this.
LEAST_UP_COSINE = 0.3
#: Costs per radian by which the horizon is off level (root mean square), and per radian by which the elevation of the
#: line of sight varies (standard deviation). The third is the cost of a view along the vertical. People turn round, but
#: seldom look up and down.
PER_ROLL, PER_TILT, PER_PITCH = 2.0, 1.0, 0.5


@dataclass(frozen=True)
class _Prices:
    """Additional costs of a guess at what is up.

    `axis`: an unusual axis. `turn`: a turned picture.
    `between`: a direction between the axes; None if such a direction is never guessed.
    `nadir`: a camera that looks straight down along the usual axis. `nadir_deg`: largest deviation from that view,
    degrees.
    """

    axis: float
    turn: float
    between: float | None
    nadir: float
    nadir_deg: float


#: Costs in a format whose world is arbitrary (ANY_WORLD), and in a format whose world is aligned with gravity by
#: definition (LEVELLED). In ANY_WORLD, a turn of the device is believed only after every axis. It costs more than
#: another axis with a picture whose up direction differs from it by 45 degrees, the largest difference. A view straight
#: down along the usual axis is believed only if other axes have horizons that are 0.15 rad off. In LEVELLED, such a
#: view is believed before every other axis.
ANY_WORLD = _Prices(axis=0.2, turn=0.4, between=0.25, nadir=0.5, nadir_deg=5.0)
LEVELLED = _Prices(axis=0.4, turn=0.1, between=None, nadir=0.3, nadir_deg=18.0)
#: Costs that compare horizons alone.
FREE = _Prices(axis=0.0, turn=0.0, between=None, nadir=0.0, nadir_deg=18.0)
#: A direction between the axes is believed if the cameras pan by at least LEAST_PAN, radians (root mean square). Also,
#: its cosine with every axis must be at most MOST_AXIS_COSINE.
LEAST_PAN, MOST_AXIS_COSINE = 0.15, 0.995
#: The world's axes count as the first picture's axes (OpenGL or optical) if their cosines are above this. A note then
#: says OF_FIRST, as nothing else shows this case.
AS_FIRST = 1 - 1e-8
OF_FIRST = "; the axes are those of the first picture: if that looked down or up, the floor is tilted by as much"
#: Another guess is named if its cost exceeds the least one by less than this.
NEAR = 0.1


#: A view is steeply up if the sine of its elevation is above this: 20 degrees.
LEAST_SKYWARDS = 0.34


@dataclass(frozen=True)
class Upright:
    """The up direction of a world, and how the device was held.

    `up` (3,): unit vector. `quarter`: number of clockwise quarter turns of the picture.
    `note`: how both were found, for people.
    """

    up: F64
    quarter: int
    note: str


@dataclass(frozen=True)
class _Guess:
    name: str
    up: F64
    quarter: int
    price: float
    is_nadir: bool = False


def find_upright(turns: F64, usual: str, is_levelled: bool, stated: str = AUTO) -> Upright:
    """Find the up direction of a camera's world, and the quarter turns of the camera's picture.

    `turns` (N, 3, 3): camera axes, camera to world, OpenGL.
    `usual`: axis that is usually up in the format.
    `is_levelled`: whether the format's world is aligned with gravity by definition.
    `stated`: axis that is up by the scene, or `auto`. If it is stated, only quarter turns of the picture are tried.
    """
    expected = usual if stated == AUTO else stated
    guesses = _guesses(turns, expected, LEVELLED if is_levelled else ANY_WORLD, stated)
    if not guesses:
        unknown = "usual for the format; the pictures show no horizon to tell it by"
        return Upright(np.array(UP[expected]), 0, f"{expected.upper()} up, {'as given' if stated != AUTO else unknown}")
    best = min(guesses, key=lambda guess: guess.price)
    # As in the world of a SLAM map. The sign of Y is free: optical axes count too.
    first = turns[0]
    has_first_axes = min(first[0, 0], abs(first[1, 1]), first[:, 1] @ best.up) > AS_FIRST
    of_first = OF_FIRST if best.name and not is_levelled and len(turns) > 1 and has_first_axes else ""
    return Upright(best.up, best.quarter, _note(best, usual, stated) + _rival(best, guesses, stated) + of_first)


def price_of(turns: F64, usual: str) -> float:
    """Return the least cost of any up direction for cameras `turns` (N, 3, 3); infinite if none fits.

    The cost is 0 for cameras that are level if the axis `usual` is up.
    """
    return min((guess.price for guess in _guesses(turns, usual, ANY_WORLD, AUTO)), default=math.inf)


def price_of_horizons(turns: F64) -> float:
    """Return the least cost of any up direction for cameras `turns` (N, 3, 3), by their horizons alone.

    All axes of the world and all quarter turns of the picture are tried. The cost is infinite if none fits.
    """
    return min((guess.price for guess in _guesses(turns, "y", FREE, AUTO)), default=math.inf)


def is_of_body(turns: F64, of_body: F64, usual: str) -> bool:
    """Return whether poses more likely belong to a level vehicle than to a camera.

    `turns` (N, 3, 3): camera axes if the poses are a camera's. They must need two corrections: a turned picture, and a
    view that is steeply up.
    `of_body` (N, 3, 3): camera axes if the poses are a vehicle's. They must need no correction, look ahead or down, and
    cost less by NEAR.
    `usual`: axis that is usually up in the format.
    """
    camera, body = (
        min(_guesses(one, usual, ANY_WORLD, AUTO), key=lambda guess: guess.price, default=None)
        for one in (turns, of_body)
    )
    if camera is None or body is None or not camera.quarter or body.quarter or {camera.name, body.name} != {usual}:
        return False
    skywards, ahead = (-float(one[:, :, 2].mean(axis=0) @ UP[usual]) for one in (turns, of_body))
    return skywards > LEAST_SKYWARDS and ahead < LEAST_SKYWARDS and body.price < camera.price - NEAR


def _guesses(turns: F64, expected: str, prices: _Prices, stated: str) -> list[_Guess]:
    axes = UP if stated == AUTO else {stated: UP[stated]}
    guesses = [
        _Guess(name, np.array(up), quarter, price + (name != expected) * prices.axis + (quarter > 0) * prices.turn)
        for name, up in axes.items()
        for quarter in range(4)
        if (price := _price(turns, np.array(up), quarter)) is not None
    ]
    looks_down = turns[:, :, 2].mean(axis=0) @ UP[expected] > np.cos(np.radians(prices.nadir_deg))
    # If the map has the axes of the first picture, such a camera looks ahead along an axis.
    if stated == AUTO and looks_down and np.abs(np.diag(turns[0])).min() <= AS_FIRST:
        guesses.append(_Guess(expected, np.array(UP[expected]), 0, prices.nadir, is_nadir=True))
    if stated != AUTO or prices.between is None:
        return guesses
    return guesses + _between(turns, prices.between)


def _ups_and_rights(turns: F64, quarter: int) -> tuple[F64, F64]:
    """Return (up directions, right directions), (N, 3) each, of pictures after `quarter` quarter turns."""
    x, y = turns[:, :, 0], turns[:, :, 1]
    return ((y, x), (-x, y), (-y, -x), (x, -y))[quarter]


def _price(turns: F64, up: F64, quarter: int) -> float | None:
    """Return the cost of a guess by horizons and views; None if it turns the pictures upside down or sideways."""
    ups, rights = _ups_and_rights(turns, quarter)
    cosine = float((ups @ up).mean())
    if cosine <= LEAST_UP_COSINE:
        return None
    roll, tilt = float(np.sqrt(np.mean((rights @ up) ** 2))), float(np.std(turns[:, :, 2] @ up))
    return PER_ROLL * roll + PER_TILT * tilt + PER_PITCH * (1.0 - cosine)


def _between(turns: F64, dearer: float) -> list[_Guess]:
    """Return the guess that the direction most nearly perpendicular to all right axes is up; [] if it is not believed.

    `dearer`: cost to add to the guess.
    """
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
    if best.is_nadir:
        return f"{best.name.upper()} up, usual for the format, as the camera looks straight down"
    if best.name != usual:
        return f"{best.name.upper()} up, as the camera is held (not {usual.upper()}, usual for the format){turned}"
    return f"{best.name.upper()} up{turned}"


def _rival(best: _Guess, guesses: list[_Guess], stated: str) -> str:
    """Return words on the second cheapest of `guesses`, if it is nearly as cheap as `best` but far from it; else ""."""
    for guess in guesses:
        if guess.is_nadir and guess.name != best.name:
            return f"; {guess.name.upper()} up fits if it looks straight down: camera.up_axis decides"
    rivals = [g for g in guesses if g.name and g is not best and g.price < best.price + NEAR]
    rivals = [g for g in rivals if g.quarter != best.quarter or g.up @ best.up < np.sqrt(0.5)]
    if not rivals or stated != AUTO:
        return ""
    rival = min(rivals, key=lambda guess: guess.price)
    turned = f" with the picture turned by {rival.quarter * 90} degrees" if rival.quarter else ""
    return f"; {rival.name.upper()} up{turned} fits nearly as well: camera.up_axis decides"


FILM_RATE_HZ = 30.0
FILM_STEP_DEG = 6.0


def times_without(turns: F64, rate_hz: float | None) -> tuple[F64, str]:
    """Return (times (N,), seconds, for views without times; words on their rate).

    `turns` (N, 3, 3): camera axes, OpenGL or optical. `rate_hz`: views a second by the scene; None if the scene does
    not say. Without a rate, views that are less than FILM_STEP_DEG apart are a film, and other views are stills.
    """
    ahead = turns[:, :, 2]
    cosine = np.clip((ahead[1:] * ahead[:-1]).sum(axis=1), -1, 1)
    finite = cosine[np.isfinite(cosine)]
    step = float(np.degrees(np.median(np.arccos(finite)))) if len(finite) else 0.0
    rate, how = FILM_RATE_HZ, f"{FILM_RATE_HZ:g} a second assumed"
    if rate_hz is not None:
        rate, how = rate_hz, f"{rate_hz:g} a second as given"
    elif step > FILM_STEP_DEG:
        rate, how = 1.0, f"stills {step:.0f} degrees apart, 1 a second"
    return np.arange(len(turns)) / rate, how


#: A matrix counts as a rotation if the entries of |R^T R - 1| are below this.
SKEW = 0.05
#: Positions with a coordinate beyond this are left out, metres, after the map is moved to the origin.
FARTHEST_M = 1e5
NOT_FINITE, FAR_OFF = "not finite", f"farther than {FARTHEST_M / 1000:.0f} km from the others"
#: Converts between optical axes (x right, y down, z ahead) and OpenGL axes.
OPENGL_FROM_OPTICAL: F64 = np.diag([1.0, -1.0, -1.0])


@dataclass(frozen=True)
class RawCamera:
    """The content of a camera file, before poses are left out and the world is turned.

    `times_s` (N,): times in seconds.
    `turns` (N, 3, 3), `places` (N, 3): camera to world, in the file's unit. A reader returns the axes of the file's
    poses; `path_from_recording` takes OpenGL axes.
    `usual_up`: axis of the world that is usually up in the format.
    `lenses`: one lens for all poses or one for each, of pictures along the axes of the poses.
    `lens`: source of the lenses, in words.
    `notes`: notes on the file, for people.
    `place_of`: place of a sample in the file.
    `detected`: facts about the file, but not its axes and lens.
    `pictures`: name of the photo of each pose; empty if the file names none.
    `is_levelled`: whether the format's world is aligned with gravity by definition.
    `unit`: unit of lengths by the format.
    `began_s`: time 0 of `times_s` in seconds since 1970; None if the file does not state it.
    `lengths`: unit of positions by the file's column names, "" without one.
    """

    times_s: F64
    turns: F64
    places: F64
    usual_up: str
    lenses: tuple[Lens, ...]
    lens: str
    notes: tuple[str, ...]
    place_of: PlaceOf = by_number
    detected: Detected = NOTHING
    pictures: tuple[str, ...] = ()
    is_levelled: bool = False
    unit: LengthUnit = LengthUnit.METRES
    began_s: float | None = None
    lengths: str = ""


def path_from_recording(raw: RawCamera, where: str, spec: CameraSpec) -> CameraPath:
    """Return the camera path of a file.

    `raw`: content of the file, with OpenGL axes.
    `where`: path of the file, for messages.
    `spec`: camera of the scene.
    Raises BadInputError when more than half of the poses are unusable, or when two stated units differ.
    """
    places_m, spec, length_notes = _in_metres(raw, where, spec)
    near, offset_notes = near_origin(places_m)
    faults = _faults(raw.times_s, raw.turns, near)
    readable = ~np.logical_or.reduce(list(faults.values()))
    broken = " or ".join(fault for fault, of in faults.items() if of.any())
    usable, repairs = usable_samples(where, raw.times_s, readable, raw.place_of, broken or NOT_FINITE)
    times, turns, places = raw.times_s[usable], raw.turns[usable], near[usable]
    upright = find_upright(turns, raw.usual_up, raw.is_levelled, spec.up_axis)
    world = shortest_turn(upright.up, np.array(UP["y"]))
    quats = quat_from_matrix(world @ turns @ about(2, np.array(upright.quarter * np.pi / 2)))
    optics, seen = _optics(raw, usable, upright.quarter, spec)
    fov_y_deg = float(np.median([lens.fov_y_deg for lens in optics.lenses]))
    scale, scale_notes = metres_per_unit(
        turns, places, times, fov_y_deg, raw.unit if not raw.lengths else LengthUnit.METRES, spec
    )
    notes = (*raw.notes, *length_notes, *offset_notes, upright.note, *scale_notes, seen, *repairs)
    unit = " ".join((*length_notes, *scale_notes)) or raw.detected.unit
    detected = replace(raw.detected, axes=upright.note, unit=unit, lens=seen)
    pictures = tuple(raw.pictures[k] for k in usable) if raw.pictures else ()
    return CameraPath(
        times - times[0],
        quats,
        scale * places @ world.T,
        optics,
        notes,
        detected=detected,
        pictures=pictures,
        quarter=upright.quarter,
        began_s=None if raw.began_s is None else raw.began_s + float(times[0]),
    )


def _in_metres(raw: RawCamera, where: str, spec: CameraSpec) -> tuple[F64, CameraSpec, tuple[str, ...]]:
    """Return (positions (N, 3), camera of the scene, notes) after the unit that column names state is applied.

    If the names state another unit than metres, the positions are converted, and `metres_per_unit` of the camera
    becomes None. If the names state metres, nothing changes and `metres_per_unit` of the scene counts: programs write
    `[m]` over maps that nobody measured. Raises BadInputError when the scene states another unit than the names.
    """
    metres = LENGTH_UNITS.get(raw.lengths, 1.0)
    if metres == 1.0:
        return raw.places, spec, ()
    if spec.metres_per_unit is not None and not math.isclose(spec.metres_per_unit, metres, rel_tol=SAME_UNIT):
        found = f"column names with lengths in {raw.lengths} and camera.metres_per_unit = {spec.metres_per_unit:g}"
        raise BadInputError(where, found, f"{metres:g} metres in a unit", "remove the wrong one")
    note = f"lengths in {raw.lengths} by the column names: 1 unit of the file is {metres:g} m"
    return raw.places * metres, spec.model_copy(update={"metres_per_unit": None}), (note,)


def _optics(raw: RawCamera, usable: NDArray[np.intp], quarter: int, spec: CameraSpec) -> tuple[Optics, str]:
    """Return (lenses of the poses with the indices `usable`, source of the lenses in words)."""
    if spec.fov_y_deg is not None:
        optics = one_lens(spec.fov_y_deg, spec.near_m, spec.far_m)
        return optics, f"field of view {spec.fov_y_deg:.4g} degrees high, as given"
    own = raw.lenses if len(raw.lenses) == 1 else tuple(raw.lenses[k] for k in usable)
    lenses = tuple(lens.turned(quarter) for lens in (own[:1] if len(set(own)) == 1 else own))
    angles = sorted({f"{lens.fov_y_deg:.4g}" for lens in lenses}, key=float)
    return Optics(lenses, spec.near_m, spec.far_m), (
        f"field of view {' to '.join(dict.fromkeys((angles[0], angles[-1])))} degrees high, {raw.lens}"
    )


def _faults(times_s: F64, turns: F64, places: F64) -> dict[str, NDArray[np.bool_]]:
    """Return, by fault in words, a mask (N,) of the poses with this fault; a pose has at most one fault."""
    finite = np.isfinite(times_s) & np.isfinite(turns).all(axis=(1, 2)) & np.isfinite(places).all(axis=1)
    safe, near = np.where(finite[:, None, None], turns, 0.0), np.where(finite[:, None], places, 0.0)
    rotation = are_rotations(safe)
    is_far = (np.abs(near) >= FARTHEST_M).any(axis=1)
    return {NOT_FINITE: ~finite, "no rotation": finite & ~rotation, FAR_OFF: finite & rotation & is_far}


def are_rotations(matrices: F64, skew: float = SKEW) -> NDArray[np.bool_]:
    """Return a mask (N,) of the `matrices` (N, 3, 3) that are rotations.

    The entries of |R^T R - 1| must be below `skew`, and the determinant above 0.
    """
    with np.errstate(over="ignore", invalid="ignore"):
        off = np.abs(np.swapaxes(matrices, -1, -2) @ matrices - np.eye(3)).max(axis=(1, 2))
        return np.asarray((off < skew) & (np.linalg.det(matrices) > 0))
