"""One small fault. Rule: it is some lines of one file, and what stands there instead."""

from __future__ import annotations

import re
from collections.abc import Callable
from typing import NamedTuple

#: Folders whose own folders are counted by themselves.
SPLIT = {"stages", "scene"}


class Edit(NamedTuple):
    """A fault in one text. `line`: where it begins, from 1. `kind`: what was done. `make()`: the whole new text."""

    line: int
    kind: str
    make: Callable[[], str]


class Fault(NamedTuple):
    """In the file `path`, relative to the tree, the lines `old`, at `line` when it was drawn, become `new`."""

    path: str
    line: int
    kind: str
    old: str
    new: str

    @property
    def folder(self) -> str:
        """The folder that it is counted under."""
        parts = self.path.split("/")
        if parts[0] == "src":
            return "trilane"
        return "/".join(parts[:2]) if parts[0] in SPLIT and len(parts) > 2 else parts[0]

    @property
    def before(self) -> str:
        return _one_line(self.old)

    @property
    def after(self) -> str:
        return _one_line(self.new)

    def __str__(self) -> str:
        return f"{self.path}:{self.line} [{self.kind}] {self.before}  ->  {self.after}"

    def still_fits(self, text: str) -> bool:
        """Whether the file with this text still has its lines."""
        return bool(self._places(text))

    def put_into(self, text: str) -> str:
        """The text with the fault, where `old` stands nearest to its line. Raises ValueError when it does not."""
        wanted = sum(len(line) for line in text.splitlines(keepends=True)[: self.line - 1])
        places = self._places(text)
        if not places:
            raise ValueError(f"{self.path}: no longer has the lines {self.before!r}")
        place = min(places, key=lambda each: abs(each - wanted))
        return text[:place] + self.new + text[place + len(self.old) :]

    def _places(self, text: str) -> list[int]:
        """Where `old` stands from the begin of a line; places may overlap."""
        return [found.start() for found in re.finditer(f"^(?={re.escape(self.old)})", text, re.MULTILINE)]


def fault_between(path: str, kind: str, text: str, changed: str) -> Fault:
    """The fault that makes `changed` of `text`, which differ: whole lines, and one more where only lines were added."""
    before, after = text.splitlines(keepends=True), changed.splitlines(keepends=True)
    shorter = min(len(before), len(after))
    head = next((n for n in range(shorter) if before[n] != after[n]), shorter)
    tail = next((n for n in range(shorter - head) if before[-1 - n] != after[-1 - n]), shorter - head)
    if head + tail == len(before):
        tail -= 1
    return Fault(
        path, head + 1, kind, "".join(before[head : len(before) - tail]), "".join(after[head : len(after) - tail])
    )


def _one_line(lines: str) -> str:
    return " ".join(line.strip() for line in lines.splitlines())
