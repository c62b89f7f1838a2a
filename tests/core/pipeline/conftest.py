"""A reader of other tools' measurements."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

from trilane.pipeline.measurements.read_file import Measurements, read_measurements


@pytest.fixture
def read(tmp_path: Path) -> Callable[[str | bytes], Measurements]:
    """What is read of a file with this content."""

    def reader(content: str | bytes) -> Measurements:
        path = tmp_path / "file"
        path.write_bytes(content.encode() if isinstance(content, str) else content)
        return read_measurements(path)

    return reader
