"""A background that the user brings: the order and times of its pictures, and the camera that filmed it.

A recorded camera counts as the camera that filmed the background. Camera and background begin together and repeat
together, and the camera's picture is cut in the same way as the background. If the camera's file names photos of the
background, each photo is shown with its own pose.

Pictures of a folder follow each other by name, with numbers compared as numbers. If the names differ only in one
number, the pictures are the frames of a film, and the number gives each frame's time. While a frame is missing, the
picture before it is shown. Names that are times, as in robots' data sets, give the times directly.
"""

from __future__ import annotations

import re
from bisect import bisect_right
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import PurePosixPath
from statistics import median
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from trilane.arrays import Shape
from trilane.scene.camera.path import CameraPath, Optics
from trilane.scene.lens import Known, Lens, cover
from trilane.scene.recordings import EARLIEST_S, GAP, LATEST_S, natural
from trilane.scene.rotations import quat_from_matrix

#: Numbers in names count a film's frames if at least the share LEAST_IN_STEP of neighbours is one step apart. Also, the
#: film must have fewer than MOST_MISSING frames for each picture.
LEAST_IN_STEP, MOST_MISSING = 0.5, 4
NAMED_GAPS = 3
#: Patterns of names that are times since 1970, with their unit in seconds.
CLOCKS = {r"\d{10}\.\d{1,9}": 1.0, r"\d{13}": 1e-3, r"\d{16}": 1e-6, r"\d{19}": 1e-9}
ROUNDING_S = 1e-6
LAST_NUMBER = re.compile(r"(.*?)(\d{1,15})(\D*)\Z", re.DOTALL)


@dataclass(frozen=True)
class Film:
    """The times of a folder's pictures.

    `times_s`: time at which each picture is first shown, from 0.
    `period_s`: time after which the film starts again.
    `rate`: notes on the rate of the pictures and on missing pictures.
    `began_s`: time of the first picture, seconds since 1970; None if the names do not state it.
    """

    times_s: tuple[float, ...]
    period_s: float
    rate: tuple[str, ...]
    began_s: float | None = None

    def number_at(self, time_s: float) -> int:
        """Return the index of the picture that is shown at `time_s`."""
        return bisect_right(self.times_s, (time_s + ROUNDING_S) % self.period_s) - 1


def in_order(names: Sequence[str]) -> list[str]:
    """Return file names in their order, with numbers compared as numbers: `img9` before `img10`."""
    return sorted(names, key=lambda name: (natural(name), name))


def film_of(names: Sequence[str], fps: float) -> Film:
    """Return the times of a folder's pictures.

    `names`: file names in order, at least one. `fps`: pictures a second; ignored if the names are times.
    """
    clock = _clock(names)
    if clock:
        times = tuple(time - clock[0] for time in clock)
        steps = sorted(later - earlier for earlier, later in pairwise(times))
        usual = median(steps)
        rate = [f"{1 / usual:.4g}/s by the times that are their names"]
        gaps = sum(step > GAP * usual for step in steps)
        if gaps:
            longest = f"{gaps} gap{'s' * (gaps > 1)}, the longest {1000 * steps[-1]:.0f} ms"
            rate.append(f"{longest}: the picture before is held")
        return Film(times, times[-1] + usual, tuple(rate), clock[0])
    numbers = _numbers(names)
    step = _step(numbers)
    frames = [(number - numbers[0]) // step for number in numbers] if step else list(range(len(names)))
    missing = _missing(numbers, step) if step else ""
    times = tuple(frame / fps for frame in frames)
    return Film(times, (frames[-1] + 1) / fps, (f"{fps:g}/s", *((missing,) if missing else ())))


def _clock(names: Sequence[str]) -> list[float]:
    """Return the times that the names state, seconds since 1970.

    The list is empty for one picture, for other names, and for times that do not increase.
    """
    stems = [name.rpartition(".")[0] for name in names]
    for pattern, unit in CLOCKS.items():
        times = [float(stem) * unit for stem in stems if re.fullmatch(pattern, stem)]
        if len(times) == len(stems) > 1 and EARLIEST_S < times[0] < times[-1] < LATEST_S:
            return times if all(earlier < later for earlier, later in pairwise(times)) else []
    return []


def _numbers(names: Sequence[str]) -> list[int]:
    """Return the last number in each name; [] if the names also differ elsewhere, apart from their endings."""
    parts = [LAST_NUMBER.match(name.rpartition(".")[0]) for name in names]
    found = [part for part in parts if part]
    if len(found) < len(names) or len({(part[1], part[3]) for part in found}) > 1:
        return []
    return [int(part[2]) for part in found]


def _step(numbers: Sequence[int]) -> int:
    """Return the step of `numbers` from one frame to the next; 0 if they do not number the frames of a film."""
    steps = Counter(later - earlier for earlier, later in pairwise(numbers))
    if not steps:
        return 0
    step, times = min(steps.items(), key=lambda item: (-item[1], item[0]))
    if min(steps) <= 0 or times < LEAST_IN_STEP * (len(numbers) - 1) or any(other % step for other in steps):
        return 0
    return step if (numbers[-1] - numbers[0]) // step < MOST_MISSING * len(numbers) else 0


def _missing(numbers: Sequence[int], step: int) -> str:
    gaps = [(earlier + step, later - step) for earlier, later in pairwise(numbers) if later - earlier > step]
    if not gaps:
        return ""
    count = sum((last - first) // step + 1 for first, last in gaps)
    named = [f"{first}" if first == last else f"{first} to {last}" for first, last in gaps[:NAMED_GAPS]]
    more = " and others" if len(gaps) > NAMED_GAPS else ""
    return f"{count} numbers missing ({', '.join(named)}{more}): the picture before is held"


#: If the lengths of camera and background differ by more than this share, a note says it.
LIKE_LENGTH = 0.05
#: Two shapes differ if the ratio of their aspects is off 1 by this or more.
LIKE_ASPECT = 0.01
#: A camera that moves farther than this, metres, does not fit a picture that stands still.
STILL_M = 0.05
NAMED = 3

T = TypeVar("T")


@dataclass(frozen=True)
class Stored:
    """A picture, or the frames of a video, as stored in a file.

    `shape`: (height, width) of the stored pixels, scaled to square pixels. `turned`: number of quarter turns clockwise
    that the file prescribes for display.
    """

    shape: Shape
    turned: int = 0

    def shown(self, turned: int | None = None) -> Shape:
        """Return (height, width) after `turned` quarter turns; None: after the turns that the file prescribes."""
        return self.shape[::-1] if (self.turned if turned is None else turned) % 2 else self.shape


@dataclass(frozen=True)
class Footage:
    """A background that the user brings.

    `what`, `rate`: notes on the kind of background and on its frame rate.
    `stored`: the video or the picture; for a folder, each of its pictures.
    `files`: file names of the pictures, in the order of `stored`; empty for a video.
    `folder`: folder of the files.
    `period_s`: time after which the background starts again; 0 for a single picture.
    `clock_s`: time of each picture, seconds since 1970, increasing; empty if the names do not state it.
    """

    what: tuple[str, ...]
    rate: tuple[str, ...]
    stored: tuple[Stored, ...]
    files: tuple[str, ...] = ()
    folder: str = ""
    period_s: float = 0.0
    clock_s: tuple[float, ...] = ()


def filmed(path: CameraPath, footage: Footage | None, output: Shape) -> tuple[CameraPath, tuple[str, ...]]:
    """Return (`path` as the camera that filmed `footage`, notes on the background).

    A built-in camera stays as it is.
    `footage`: None for a drawn background. `output`: (height, width) of the shown picture.
    """
    if footage is None:
        return path, ()
    if not path.recorded:
        return path, (
            *footage.what,
            *footage.rate,
            _loop(footage),
            cut_note([one.shown() for one in footage.stored], output),
        )
    matched, notes = _by_clock(path, footage) or _with_photos(path, footage)
    if matched is None:
        return _over_all(path, footage, output, notes)
    camera, stored = matched
    camera, turn_notes = _turned(camera, stored)
    shapes = camera.optics.filmed
    return camera, (*footage.what, *notes, *turn_notes, cut_note(shapes, output), *_shape_notes(camera))


def _over_all(
    path: CameraPath, footage: Footage, output: Shape, notes: tuple[str, ...]
) -> tuple[CameraPath, tuple[str, ...]]:
    """Return (camera that filmed the whole footage, notes on the background)."""
    camera, turn_notes = _turned(path, footage.stored[:1])
    camera = replace(camera, repeat_s=footage.period_s)
    return camera, (
        *footage.what,
        *footage.rate,
        _loop(footage),
        *notes,
        *turn_notes,
        cut_note(camera.optics.filmed, output),
        *_shape_notes(camera),
        *_length_notes(path, footage),
    )


def _turned(path: CameraPath, stored: tuple[Stored, ...]) -> tuple[CameraPath, tuple[str, ...]]:
    """Return (`path` with the shape of each picture and the turns that make each picture fit the camera, notes)."""
    lenses = path.optics.lenses
    turns = tuple(
        _turn(lenses[k % len(lenses)], path.quarter, one, is_own=path.is_held) for k, one in enumerate(stored)
    )
    shapes = tuple(one.shown(turned) for one, turned in zip(stored, turns, strict=True))
    differ = sum((one.turned - turned) % 4 != 0 for one, turned in zip(stored, turns, strict=True))
    as_files_say = not differ and not path.is_held  # () also keeps mirroring, and turns of a folder's other pictures
    optics = replace(path.optics, filmed=_once(shapes), turned=() if as_files_say else _once(turns))
    said = f" ({differ} of {len(stored)})" if len(stored) > 1 else ""
    note = (f"turned with the camera's picture, and not as the file says{said}",) if differ else ()
    return replace(path, optics=optics), note


def _turn(lens: Lens, quarter: int, stored: Stored, is_own: bool) -> int:
    """Return the number of quarter turns clockwise after which `stored` is seen upright through `lens`.

    `quarter`: quarter turns of the lens. `is_own`: whether the camera's file measured the lens on this photo. Such a
    photo was measured either as stored or as its file displays it; the shape of the lens decides. Any other photo has
    the turn that its file states, with one exception. If stored pixels have the shape of a measured lens, but lie
    across it when displayed, they have the lens's turn.
    """
    measured = lens.turned(-quarter)
    if is_own and lens.known is Known.ALL:
        is_as_stored = not measured.lies_across(stored.shape) or measured.lies_across(stored.shown())
        return (quarter if is_as_stored else quarter + stored.turned) % 4
    is_aside = lens.lies_across(stored.shown()) and lens.known is Known.ALL and _is_like(measured, stored.shape)
    return quarter % 4 if is_aside else stored.turned % 4


def _once(values: tuple[T, ...]) -> tuple[T, ...]:
    """Return `values`, reduced to one value if all are equal."""
    return values[:1] if len(set(values)) == 1 else values


def _with_photos(
    path: CameraPath, footage: Footage
) -> tuple[tuple[CameraPath, tuple[Stored, ...]] | None, tuple[str, ...]]:
    """Match the poses of `path` to photos of `footage` by name.

    Return ((path, photos), notes). Poses whose photo is missing are removed from the path. If no photo matches, None
    takes the place of (path, photos).
    """
    if not path.pictures or not footage.files:
        return None, ()
    places = _matches(path.pictures, footage)
    if not places:
        first = PurePosixPath(path.pictures[0]).name
        return None, (f"it has none of the {len(path.pictures)} photos that the camera's file names, such as {first}",)
    kept = np.array(sorted(places))
    camera = replace(
        path,
        times_s=path.times_s[kept] - path.times_s[kept[0]],
        quats=path.quats[kept],
        places=path.places[kept],
        optics=_of_samples(path.optics, kept),
        pictures=tuple(f"{footage.folder}/{footage.files[places[int(k)]]}" for k in kept),
        is_held=True,
    )
    missing = [PurePosixPath(name).name for k, name in enumerate(path.pictures) if k not in places]
    notes = [
        f"{len(kept)} of the camera's {len(path.pictures)} views have their photo here, by name; each is held with it"
    ]
    if missing:
        named = ", ".join(missing[:NAMED]) + (" and others" if len(missing) > NAMED else "")
        notes.append(f"photos of {len(missing)} views are missing ({named}): these views are skipped")
    return (camera, tuple(footage.stored[places[int(k)]] for k in kept)), tuple(notes)


def _by_clock(
    path: CameraPath, footage: Footage
) -> tuple[tuple[CameraPath, tuple[Stored, ...]], tuple[str, ...]] | None:
    """Match the pictures of `footage` to times of `path` by their clocks.

    Return ((path, pictures), notes): the pictures that were taken during the camera's recording, and the path sampled
    at their times. The result is None if there are no such pictures, or if the camera's file states no clock.
    """
    if path.began_s is None:
        return None
    times = np.array(footage.clock_s) - path.began_s
    within = np.flatnonzero((times >= 0) & (times <= path.duration_s))
    if not len(within):
        return None
    poses = [path.pose(float(t_s)) for t_s in times[within]]
    sampled = replace(
        path,
        times_s=times[within] - times[within[0]],
        quats=quat_from_matrix(np.stack([turn for turn, _ in poses])),
        places=np.stack([place for _, place in poses]),
        optics=replace(path.optics, lenses=_once(tuple(path.own_lens(float(t_s)) for t_s in times[within]))),
        pictures=tuple(f"{footage.folder}/{footage.files[k]}" for k in within),
        is_held=True,
        began_s=float(footage.clock_s[within[0]]),
    )
    notes = (
        f"{len(within)} of its {len(times)} pictures were taken during the camera's recording, by the clock, the first "
        f"{times[within[0]]:.2f} s after it began: each is held with the camera's place at its time",
    )
    return (sampled, tuple(footage.stored[k] for k in within)), notes


def _of_samples(optics: Optics, kept: NDArray[np.intp]) -> Optics:
    """Return `optics` with only the lenses of the samples with indices `kept`."""
    return optics if len(optics.lenses) == 1 else replace(optics, lenses=tuple(optics.lenses[k] for k in kept))


def _matches(names: tuple[str, ...], footage: Footage) -> Mapping[int, int]:
    """Return {index in `names`: index of the file in the footage's folder} for each name that has a file.

    Names are compared without their folders; endings need not match. If several names are equal without their folders,
    only those count whose folder has the name of the footage's folder.
    """
    paths = [PurePosixPath(name.replace("\\", "/")) for name in names]
    if len({one.name for one in paths}) < len(paths):
        here = PurePosixPath(footage.folder).name
        meant = {k: one for k, one in enumerate(paths) if one.parent.name == here}
    else:
        meant = dict(enumerate(paths))
    whole = {name: number for number, name in enumerate(footage.files)}
    stems = {PurePosixPath(name).stem: number for name, number in reversed(whole.items())}
    found = {k: whole.get(one.name, stems.get(one.name, stems.get(one.stem))) for k, one in meant.items()}
    return {k: number for k, number in found.items() if number is not None}


def _loop(footage: Footage) -> str:
    return f"{footage.period_s:.2f} s, then starts again" if footage.period_s else "stands still"


def cut_note(shapes: tuple[Shape, ...] | list[Shape], output: Shape) -> str:
    """Return a note on what part of pictures of `shapes` is cut off when they cover `output`; all (height, width)."""
    height, width = output
    cuts = {_cut(shape, output) for shape in shapes}
    how = cuts.pop() if len(cuts) == 1 else "cut according to their shapes"
    return f"shown at {width}x{height}: {how}"


def _cut(shape: Shape, output: Shape) -> str:
    cut = cover(shape, output)
    lost_rows, lost_columns = 1 - output[0] / cut.height, 1 - output[1] / cut.width
    if max(lost_rows, lost_columns) < 1e-9:
        return "all of it"
    side, lost = ("height", lost_rows) if lost_rows > lost_columns else ("width", lost_columns)
    return f"{lost:.0%} of its {side} cut off, equally at both ends"


def _shape_notes(path: CameraPath) -> tuple[str, ...]:
    """Return a note if the camera's lens does not fit the background that it is said to have filmed."""
    lens, shape = path.optics.lenses[0], path.optics.filmed[0]
    if lens.lies_across(shape):
        held, lies = ("upright", "lies") if lens.height_px > lens.width_px else ("level", "stands")
        return (
            f"the camera was held {held} and the background {lies}: turn it if it is on its side; else they do not fit",
        )
    if lens.known is not Known.ALL or _is_like(lens, shape):
        return ()
    size = f"{lens.width_px:.0f}x{lens.height_px:.0f}"
    return (f"taken for the middle of the camera's picture of {size}, which has another shape",)


def _is_like(lens: Lens, shape: Shape) -> bool:
    """Return whether a picture of `shape` (height, width) has nearly the aspect ratio of the lens's picture."""
    return abs(lens.width_px * shape[0] / (lens.height_px * shape[1]) - 1) < LIKE_ASPECT


def _length_notes(path: CameraPath, footage: Footage) -> tuple[str, ...]:
    if len(path.times_s) == 1:
        return ()
    if not footage.period_s:
        farthest = float(np.linalg.norm(path.places - path.places[0], axis=1).max())
        is_moving = farthest > STILL_M
        return (f"it does not follow the camera, which moves by up to {farthest:.1f} m",) if is_moving else ()
    if abs(footage.period_s - path.duration_s) <= LIKE_LENGTH * footage.period_s:
        return ()
    return (f"the camera's recording lasts {path.duration_s:.2f} s: they may not belong together",)
