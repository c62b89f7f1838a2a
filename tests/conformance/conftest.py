"""What the conformance suites share."""

from __future__ import annotations

import pytest

from trilane.stages.dsp.runtime import RUNTIMES


@pytest.fixture
def skip_without():
    """Skips the test when the runtime that it is called with is not installed, and says how to get it."""

    def skip(name):
        if not RUNTIMES[name].is_installed:
            pytest.skip(f"runtime {name} is not installed: {RUNTIMES[name].install()}")

    return skip
