"""Fixtures that several folders of tests share."""

from __future__ import annotations

from pathlib import Path

import pytest

SHARED = Path(__file__).resolve().parents[2] / "shared"


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """Real inputs that lie beside the checkout; the test is skipped where they do not."""
    folder = SHARED / "data"
    if not folder.is_dir():
        pytest.skip(f"no real inputs at {folder}")
    return folder
