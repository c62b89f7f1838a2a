"""What the conformance suites share."""

from __future__ import annotations

import pytest

from trilane.stages.dsp.runtime import RUNTIMES

#: Needs an NVIDIA GPU: `make test-device` asks for it by name.
WITH_GPU = "cuda"


def pytest_generate_tests(metafunc):
    """Every test of the contract runs on each runtime, or on those of `--runtime`."""
    if "name" in metafunc.fixturenames:
        asked = metafunc.config.getoption("--runtime") or [name for name in RUNTIMES if name != WITH_GPU]
        metafunc.parametrize("name", asked, indirect=True)


@pytest.fixture
def skip_without():
    """Skips the test when the runtime that it is called with is not installed, and says how to get it."""

    def skip(name):
        if not RUNTIMES[name].is_installed:
            pytest.skip(f"runtime {name} is not installed: {RUNTIMES[name].install()}")

    return skip
