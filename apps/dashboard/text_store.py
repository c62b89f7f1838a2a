"""Texts by their place in a temporary file without a name. Rule: none of them is kept in memory."""

from __future__ import annotations

import os
import tempfile
from typing import IO


class TextStore:
    """`add` gives the place and length by which `read` finds the bytes again."""

    def __init__(self) -> None:
        self._file: IO[bytes] = tempfile.TemporaryFile(prefix="trilane-", buffering=0)  # noqa: SIM115 - `close` closes it

    def add(self, text: bytes) -> tuple[int, int]:
        offset = self._file.seek(0, os.SEEK_END)
        self._file.write(text)
        return offset, len(text)

    def read(self, offset: int, size: int) -> bytes:
        return os.pread(self._file.fileno(), size, offset)

    def close(self) -> None:
        """The file is gone."""
        self._file.close()
