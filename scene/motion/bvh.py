"""Reads BVH files: the skeleton, and the channels of every frame in the file's order.

Rule: this module knows syntax only; `bvh_retarget.py` interprets the joints' names. Every error names the line.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from trilane.arrays import F64
from trilane.errors import BadInputError
from trilane.files import read_text
from trilane.scene.rotations import about

EXPECTED = "a BVH file: HIERARCHY, MOTION, Frames, Frame Time, one line of channels a frame"
MAX_JOINTS = 1000
MAX_FRAMES = 200_000
CHANNELS = {f"{axis}{kind}": (kind, k) for kind in ("position", "rotation") for k, axis in enumerate("XYZ")}
_CHANNEL_OF = {name.lower(): name for name in CHANNELS}


@dataclass
class BvhJoint:
    """One joint of the file.

    `parent`: index of its parent, -1 at a root; a file may have several roots. `offset` (3,): vector from its parent,
    file units. `channels`: names such as `Zrotation`, in file order. `first`: column of the first of them. `tip` (3,):
    offset of its end site, None without.
    """

    name: str
    parent: int
    offset: F64
    channels: tuple[str, ...] = ()
    first: int = 0
    tip: F64 | None = None


@dataclass(frozen=True)
class Bvh:
    """The content of a file.

    `frames` (T, channels): file units and degrees. `frame_time_s`: seconds per frame.
    """

    joints: list[BvhJoint]
    frames: F64
    frame_time_s: float

    def forward(self) -> tuple[F64, F64]:
        """Return global rotations (T, J, 3, 3) and positions (T, J, 3) of every joint, in file units."""
        count = len(self.frames)
        turns, places = np.empty((count, len(self.joints), 3, 3)), np.empty((count, len(self.joints), 3))
        for index, joint in enumerate(self.joints):
            turn, shift = self._local(joint)
            if joint.parent < 0:
                turns[:, index], places[:, index] = turn, shift
            else:
                above = turns[:, joint.parent]
                turns[:, index] = above @ turn
                places[:, index] = places[:, joint.parent] + (above @ shift[..., None])[..., 0]
        return turns, places

    def _local(self, joint: BvhJoint) -> tuple[F64, F64]:
        turn = np.broadcast_to(np.eye(3), (len(self.frames), 3, 3))
        shift = np.tile(joint.offset, (len(self.frames), 1))
        for column, channel in enumerate(joint.channels, joint.first):
            kind, axis = CHANNELS[channel]
            values = self.frames[:, column]
            if kind == "rotation":
                turn = turn @ about(axis, np.radians(values))
            else:
                shift[:, axis] = values
        return turn, shift


@dataclass
class _Words:
    """The words of the hierarchy, one after the other, each with its line."""

    path: Path
    words: Sequence[tuple[int, str]]
    line: int = 1
    read: int = 0

    def more(self) -> bool:
        return self.read < len(self.words)

    def next(self) -> str:
        if not self.more():
            raise self.error("the end of the file", EXPECTED)
        self.line, word = self.words[self.read]
        self.read += 1
        return word

    def want(self, *words: str) -> str:
        word = self.next()
        if word.upper() not in words:
            raise self.error(repr(word), " or ".join(words))
        return word.upper()

    def number(self) -> float:
        word = self.next()
        try:
            value = float(word)
        except ValueError:
            value = math.nan
        if not math.isfinite(value):
            raise self.error(repr(word), "a finite number")
        return value

    def offset(self) -> F64:
        self.want("OFFSET")
        return np.array([self.number() for _ in range(3)])

    def error(self, found: str, expected: str) -> BadInputError:
        return BadInputError(f"{self.path}, line {self.line}", found, expected)


@dataclass
class _Hierarchy:
    words: _Words
    joints: list[BvhJoint] = field(default_factory=list)
    columns: int = 0

    def read(self) -> None:
        """Read everything from HIERARCHY to the closing brace of the last root."""
        self.words.want("HIERARCHY")
        self.words.want("ROOT")
        self._tree()
        while self.words.more():
            word = self.words.next()
            if word.upper() != "ROOT":
                raise self.words.error(repr(word), "another ROOT or a line MOTION")
            self._tree()

    def _tree(self) -> None:
        open_joints = [self._joint(parent=-1)]
        while open_joints:
            word = self.words.want("JOINT", "END", "CHANNELS", "}")
            if word == "JOINT":
                open_joints.append(self._joint(parent=open_joints[-1]))
            elif word == "END":
                self._tip(self.joints[open_joints[-1]])
            elif word == "CHANNELS":
                self._channels(self.joints[open_joints[-1]])
            else:
                open_joints.pop()

    def _joint(self, parent: int) -> int:
        if len(self.joints) >= MAX_JOINTS:
            raise self.words.error(f"more than {MAX_JOINTS} joints", "a human skeleton")
        name = self.words.next()
        self.words.want("{")
        self.joints.append(BvhJoint(name, parent, self.words.offset()))
        return len(self.joints) - 1

    def _tip(self, joint: BvhJoint) -> None:
        self.words.want("SITE")
        self.words.want("{")
        joint.tip = self.words.offset()
        self.words.want("}")

    def _channels(self, joint: BvhJoint) -> None:
        count = self.words.number()
        if count not in range(7):
            raise self.words.error(f"{count:g} channels", "0 to 6")
        names = [self.words.next() for _ in range(int(count))]
        for name in names:
            if name.lower() not in _CHANNEL_OF:
                raise self.words.error(repr(name), "a channel such as Zrotation or Xposition")
        joint.channels, joint.first = tuple(_CHANNEL_OF[name.lower()] for name in names), self.columns
        self.columns += len(names)


def load_bvh(path: Path) -> Bvh:
    """Read `path`.

    Raises BadInputError with the line for wrong syntax, a short or long frame, or a truncated file.
    """
    lines = read_text(path, EXPECTED).splitlines()
    start = next((k for k, line in enumerate(lines) if line.strip().upper() == "MOTION"), len(lines))
    words = _Words(path, [(k + 1, word) for k, line in enumerate(lines[:start]) for word in line.split()])
    hierarchy = _Hierarchy(words)
    hierarchy.read()
    if start == len(lines):
        raise BadInputError(f"{path}, line {len(lines)}", "the end of the file", "a line MOTION")
    count = _header(path, lines, start + 1, "FRAMES:")
    frame_time = _header(path, lines, start + 2, "FRAME TIME:")
    if not 1 <= count <= MAX_FRAMES or count != int(count):
        raise BadInputError(f"{path}, line {start + 2}", f"{count:g} frames", f"1 to {MAX_FRAMES}")
    if not 1e-3 <= frame_time <= 1:
        raise BadInputError(f"{path}, line {start + 3}", f"{frame_time:g} s a frame", "0.001 to 1")
    frames = _rows(path, lines, start + 3, int(count), hierarchy.columns)
    return Bvh(hierarchy.joints, frames, frame_time)


def _header(path: Path, lines: list[str], index: int, key: str) -> float:
    where = f"{path}, line {index + 1}"
    text = " ".join(lines[index].split()) if index < len(lines) else ""
    if not text.upper().startswith(key):
        raise BadInputError(where, repr(text), f"`{key} NUMBER`")
    try:
        return float(text[len(key) :])
    except ValueError:
        raise BadInputError(where, repr(text), f"`{key} NUMBER`") from None


def _rows(path: Path, lines: list[str], start: int, count: int, columns: int) -> F64:
    numbered = [(k + 1, line) for k, line in enumerate(lines[start:], start) if line.strip()]
    if len(numbered) < count:
        raise BadInputError(f"{path}, line {len(lines)}", f"{len(numbered)} frames, then the end", f"{count} frames")
    frames = np.empty((count, columns))
    for row, (number, line) in enumerate(numbered[:count]):
        words = line.split()
        if len(words) != columns:
            raise BadInputError(f"{path}, line {number}", f"{len(words)} numbers", f"{columns}, one for each channel")
        try:
            frames[row] = [float(word) for word in words]
        except ValueError as error:
            raise BadInputError(f"{path}, line {number}", str(error), "numbers") from None
    return frames
