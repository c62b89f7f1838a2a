"""The description of one file as plain data for people and JSON, and its contact sheet.

Rule: a file is usable if the other commands can read it. Otherwise, its problem is the error that their reader raises.

A contact sheet shows skeletons, a path or points. All skeletons of a row have the same scale, and so have all views of
a path. Therefore lengths can be compared. Y is up. In the view from the front, a person who faces +Z looks at the
reader. The person's left side is blue, the right side is orange.
"""

from __future__ import annotations

import shlex
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Final

import numpy as np
from PIL import Image, ImageDraw

from trilane.arrays import F32, F64
from trilane.body.joints import BODY_JOINTS, JOINT_NAMES, JOINT_PARENTS
from trilane.errors import BadInputError
from trilane.scene.recordings import NOTHING, Detected

GROUND, LINE, TEXT = (24, 26, 30), (70, 76, 86), (235, 235, 235)
LEFT, RIGHT, MIDDLE, BEGIN, END = (92, 176, 255), (255, 172, 64), (200, 205, 212), (96, 220, 130), (255, 96, 96)
#: Name of a view -> the picture's axes to the right and upwards, as rows.
VIEWS: Final = {
    "from the front": np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]),
    "from the right": np.array([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0]]),
    "from above": np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0]]),
}
TILE, PATH_TILE = 190, 380  # pixels
MARGIN = 0.86  # share of a tile that is drawn on
LEAST_EXTENT_M = 0.2
SHARP = 2  # the sheet is drawn this factor larger and then reduced, so that lines look smooth
#: Bones of the face are left out.
DRAWN: Final = tuple(k for k in range(1, len(JOINT_NAMES)) if JOINT_NAMES[k] not in ("jaw", "left_eye", "right_eye"))
CAMERAS = 14
SPARSE = 2000  # vertices; fewer are drawn larger
FRUSTUM = np.array([[-0.8, -0.6, -1.0], [0.8, -0.6, -1.0], [0.8, 0.6, -1.0], [-0.8, 0.6, -1.0]])


@dataclass(frozen=True)
class Length:
    """The length of a recording.

    `samples`: number of usable frames or poses. `seconds`: duration. `rate_hz`: samples a second; None if unknown, as
    for a single sample.
    """

    samples: int
    seconds: float
    rate_hz: float | None

    @classmethod
    def of(cls, times_s: F64) -> Length:
        """Return the length of a recording whose samples have the increasing times `times_s` (N,), in seconds.

        The rate is 1 / the median step between two times; None for a single time.
        """
        steps = np.diff(times_s)
        rate = 1 / float(np.median(steps)) if len(steps) else None
        return cls(len(times_s), float(times_s[-1] - times_s[0]), rate)


@dataclass(frozen=True)
class Inspection:
    """The description of one file.

    `kind`: kind of the file in a word, such as `motion`. `what`: description of the file in words.
    `advice`: command that uses the file, or remedy. `detected`: format and conventions that the reader detected.
    `length`: length of a recording; None for other files.
    `facts`: further facts, by name. `notes`: notes as a run prints them. `draw`: function that draws the contact sheet;
    None for a file without a sheet. `problem`: why the file is not usable; empty for a usable file.
    """

    kind: str
    what: str
    advice: str = ""
    detected: Detected = NOTHING
    length: Length | None = None
    facts: Mapping[str, Any] = field(default_factory=dict)
    notes: tuple[str, ...] = ()
    draw: Callable[[], Image.Image] | None = None
    problem: str = ""

    @property
    def usable(self) -> bool:
        return not self.problem

    @property
    def missing(self) -> list[str]:
        """The body joints that the file does not have; empty for a file without joints."""
        mapped = self.detected.joints
        return [name for name in BODY_JOINTS if name not in mapped] if mapped else []

    def document(self, file: Path, sheet: Path | None) -> dict[str, Any]:
        """Return the document that `trilane inspect --json` prints.

        `file`: inspected file. `sheet`: contact sheet that was written; None if no sheet was written.
        """
        detected = asdict(self.detected)
        joints = {"mapped": detected.pop("joints"), "unmapped": list(detected.pop("unmapped")), "missing": self.missing}
        return {
            "file": str(file),
            "kind": self.kind,
            "what": self.what,
            "usable": self.usable,
            "problem": self.problem,
            "advice": self.advice,
            "detected": detected,
            "length": asdict(self.length) if self.length else {"samples": None, "seconds": None, "rate_hz": None},
            "joints": joints,
            "facts": dict(self.facts),
            "notes": list(self.notes),
            "sheet": str(sheet) if sheet else None,
        }


def used(option: str, file: Path) -> str:
    """Return a `trilane run` command that uses `file`, quoted for a shell.

    `option`: option that takes the file, such as `--motion`; empty if the file is an argument.
    """
    return shlex.join(["trilane", "run", *([option] if option else []), str(file)])


def refused(kind: str, what: str, error: BadInputError, file: Path) -> Inspection:
    """Return the inspection of a file that its reader refuses with `error`.

    `kind`: kind of the file. `what`: description of the file in words. The problem names the place inside of `file`.
    """
    where = error.where
    for itself in (str(file), str(file.absolute())):
        if where.startswith(itself):
            where = where.removeprefix(itself).lstrip(", :/")
    place = f"{where}: " if where else ""
    return Inspection(kind, what, error.remedy, problem=f"{place}found {error.found}, expected {error.expected}")


@dataclass(frozen=True)
class _Tile:
    """A square picture that shows points given in metres.

    `draw`: Pillow's tool that draws on the picture. `side`: side of the picture in pixels. `middle` (2,): point at the
    centre, in metres. `scale`: pixels per metre.
    """

    draw: ImageDraw.ImageDraw
    side: int
    middle: F64
    scale: float

    def at(self, points: F64) -> list[tuple[float, float]]:
        """Return the pixel coordinates (x, y), y down, of `points` (N, 2), in metres, y up."""
        pixels = (points - self.middle) * (self.scale, -self.scale) + self.side / 2
        return [(float(x), float(y)) for x, y in pixels]

    def line(self, points: F64, colour: tuple[int, int, int], width: int = 2) -> None:
        self.draw.line(self.at(points), fill=colour, width=width * SHARP, joint="curve")

    def dot(self, point: F64, colour: tuple[int, int, int], radius: float = 4) -> None:
        self.dots(point[None], colour, radius)

    def dots(self, points: F64, colour: tuple[int, int, int], radius: float) -> None:
        r = radius * SHARP
        for x, y in self.at(points):
            self.draw.ellipse((x - r, y - r, x + r, y + r), fill=colour)

    def text(self, words: str, row: int = 0) -> None:
        self.draw.text((6 * SHARP, (4 + 15 * row) * SHARP), words, fill=TEXT, font_size=12 * SHARP)


def drawn_skeletons(joints: F64, times_s: F64, path: F64) -> Image.Image:
    """Return a sheet with a row for each view: a tile for the skeleton at each time, and a tile for the pelvis path.

    `joints` (M, 55, 3): places of the joints at each time, in metres, Y up. `times_s` (M,): the times in seconds.
    `path` (T, 3): places of the pelvis, in metres, Y up.
    """
    rows: list[list[Image.Image]] = []
    extent = _extent(path)
    for name, view in VIEWS.items():
        flat = joints @ view.T
        centred = flat - (flat.min(axis=1, keepdims=True) + flat.max(axis=1, keepdims=True)) / 2
        scale = _scale(TILE, 2 * np.abs(centred).max())
        tiles = []
        for moment, places in enumerate(centred):
            picture, tile = _blank(TILE, np.zeros(2), scale)
            _bones(tile, places)
            if not rows:
                tile.text(f"{times_s[moment]:.2f} s", row=0 if moment else 1)
            if not moment:
                tile.text(name)
            tiles.append(picture)
        rows.append([*tiles, _path_tile(path @ view.T, f"pelvis, {name}", TILE, extent)])
    return _sheet(rows)


def drawn_cameras(turns: F64, places: F64) -> Image.Image:
    """Return a sheet with three views of a camera path, and the camera at up to `CAMERAS` of its places.

    `turns` (N, 3, 3): rotation matrices, camera to world; the camera looks along its own -Z axis.
    `places` (N, 3): places of the camera in the world, in metres, Y up.
    """
    chosen = np.unique(np.linspace(0, len(places) - 1, min(CAMERAS, len(places))).round().astype(int))
    size = max(float(np.ptp(places, axis=0).max()), LEAST_EXTENT_M) * 0.09
    corners = places[chosen, None] + size * np.einsum("nij,kj->nki", turns[chosen], FRUSTUM)
    every = np.concatenate([places, corners.reshape(-1, 3)])
    tiles = []
    for name, view in VIEWS.items():
        seen = places[chosen], corners, view
        tiles.append(_path_tile(places @ view.T, name, PATH_TILE, _extent(every), every @ view.T, seen))
    return _sheet([tiles])


def drawn_points(vertices: F32) -> Image.Image:
    """Return a sheet with three views of a body's points. `vertices` (V, 3): places of the points, in metres, Y up."""
    points = vertices.astype(np.float64)
    tiles, extent = [], _extent(points)
    radius = 0.5 if len(points) > SPARSE else 3
    for name, view in VIEWS.items():
        flat = points @ view.T
        low, high = flat.min(axis=0), flat.max(axis=0)
        picture, tile = _blank(PATH_TILE, (low + high) / 2, _scale(PATH_TILE, extent))
        tile.dots(flat, MIDDLE, radius)
        tile.text(f"{name}, {high[1] - low[1]:.2f} m")
        tiles.append(picture)
    return _sheet([tiles])


def _bones(tile: _Tile, places: F64) -> None:
    for joint in DRAWN:
        name = JOINT_NAMES[joint]
        colour = LEFT if name.startswith("left") else RIGHT if name.startswith("right") else MIDDLE
        tile.line(places[[JOINT_PARENTS[joint], joint]], colour, 3 if joint < 22 else 1)
    tile.dot(places[JOINT_NAMES.index("head")], MIDDLE, 5)


def _path_tile(
    path: F64,
    name: str,
    side: int,
    extent: float,
    every: F64 | None = None,
    seen: tuple[F64, F64, F64] | None = None,
) -> Image.Image:
    """Return a tile with a path and a scale bar.

    `path` (T, 2): points of the path, in metres. `name`: title of the tile. `side`: side of the tile in pixels.
    `extent`: metres that the tile shows along a side. `every` (N, 2): points whose bounding box is centred in the tile;
    None for the points of `path`.
    `seen`: places (K, 3) of the cameras to draw, corners (K, 4, 3) of their frustums, both in metres, and axes (2, 3)
    of the view; None without cameras.
    """
    room = path if every is None else every
    low, high = room.min(axis=0), room.max(axis=0)
    picture, tile = _blank(side, (low + high) / 2, _scale(side, extent))
    if seen is not None:
        _frustums(tile, *seen)
    if len(path) > 1:
        tile.line(path, MIDDLE)
    tile.dot(path[-1], END)
    tile.dot(path[0], BEGIN)
    bar = 10.0 ** np.floor(np.log10(extent))
    corner = (low + high) / 2 + np.array([-0.46, -0.46]) * side * SHARP / tile.scale
    tile.line(np.array([corner, corner + np.array([bar, 0.0])]), TEXT)
    tile.text(name)
    tile.text(f"bar: {bar:g} m", row=1)
    return picture


def _extent(points: F64) -> float:
    """Return the longest side of the bounding box of `points` (N, 3), in metres, at least `LEAST_EXTENT_M`."""
    return max(float(np.ptp(points, axis=0).max()), LEAST_EXTENT_M)


def _frustums(tile: _Tile, eyes: F64, corners: F64, view: F64) -> None:
    for eye, four in zip(eyes @ view.T, corners @ view.T, strict=True):
        tile.line(np.concatenate([four, four[:1]]), LEFT, 1)
        for corner in four:
            tile.line(np.stack([eye, corner]), LEFT, 1)


def _scale(side: int, extent: float) -> float:
    return side * SHARP * MARGIN / max(extent, 1e-9)


def _blank(side: int, middle: F64, scale: float) -> tuple[Image.Image, _Tile]:
    picture = Image.new("RGB", (side * SHARP, side * SHARP), GROUND)
    draw = ImageDraw.Draw(picture)
    draw.rectangle((0, 0, side * SHARP - 1, side * SHARP - 1), outline=LINE)
    return picture, _Tile(draw, side * SHARP, middle, scale)


def _sheet(rows: Sequence[Sequence[Image.Image]]) -> Image.Image:
    side = rows[0][0].width
    sheet = Image.new("RGB", (side * len(rows[0]), side * len(rows)))
    for y, row in enumerate(rows):
        for x, tile in enumerate(row):
            sheet.paste(tile, (x * side, y * side))
    return sheet.resize((sheet.width // SHARP, sheet.height // SHARP), Image.Resampling.LANCZOS)
