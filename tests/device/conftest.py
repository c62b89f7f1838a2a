"""Tests that need a GPU. Rule: they fail where it is absent; nothing runs on another device in its place."""

from __future__ import annotations

from typing import Any

import pytest

from trilane.stages.gpu.opengl import describe, open_context


@pytest.fixture(scope="session")
def hardware_gl() -> Any:
    """A context of a hardware driver."""
    ctx = open_context(2)
    driver = describe(ctx)
    if not driver.hardware:
        pytest.fail(f"OpenGL is drawn by software here: {driver.renderer}", pytrace=False)
    return ctx


@pytest.fixture(scope="session")
def cuda() -> Any:
    """The first CUDA device of PyTorch."""
    torch = pytest.importorskip("torch")
    if not torch.cuda.is_available():
        pytest.fail(f"PyTorch {torch.__version__} finds no CUDA device", pytrace=False)
    return torch.device("cuda")
