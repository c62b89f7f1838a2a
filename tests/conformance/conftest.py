"""What the conformance suites share."""

from __future__ import annotations

import pytest

from trilane.stages.dsp.runtime import RUNTIMES

#: Needs an NVIDIA GPU: `make test-device` asks for it by name.
WITH_GPU = "cuda"


#: An emulator: a frame of the hard cases takes it seconds.
SLOW = "qnn"


def pytest_generate_tests(metafunc):
    """Every test of a contract runs on each runtime without a GPU, or on those of `--runtime`."""
    for fixture, left_out in (("name", {WITH_GPU}), ("quick_runtime", {WITH_GPU, SLOW})):
        if fixture in metafunc.fixturenames:
            asked = metafunc.config.getoption("--runtime") or [name for name in RUNTIMES if name not in left_out]
            metafunc.parametrize(fixture, asked, indirect=True)


@pytest.fixture
def quick_runtime(request, skip_without):
    """The name of a runtime that is installed and quick."""
    skip_without(request.param)
    return request.param


@pytest.fixture
def skip_without():
    """Skips the test when the runtime that it is called with is not installed, and says how to get it."""

    def skip(name):
        if not RUNTIMES[name].is_installed:
            pytest.skip(f"runtime {name} is not installed: {RUNTIMES[name].install()}")

    return skip
