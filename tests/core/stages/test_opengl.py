"""Tests of how the OpenGL context is opened, without a driver."""

from __future__ import annotations

import sys
from pathlib import Path
from types import ModuleType
from typing import Any, NoReturn

import moderngl
import pytest

from trilane.errors import MissingPartError
from trilane.stages.gpu.opengl import open_context


@pytest.mark.parametrize("torch_is_loaded", [True, False])
def test_the_compiler_of_torch_comes_before_the_driver(
    torch_is_loaded: bool, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """A process without PyTorch does not pay for it."""
    (tmp_path / "triton.py").write_text("", encoding="utf-8")
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.delitem(sys.modules, "triton", raising=False)
    monkeypatch.delitem(sys.modules, "torch", raising=False)
    if torch_is_loaded:
        monkeypatch.setitem(sys.modules, "torch", ModuleType("torch"))
    loaded: list[bool] = []

    def create(**_options: Any) -> NoReturn:
        loaded.append("triton" in sys.modules)
        raise OSError("no driver")

    monkeypatch.setattr(moderngl, "create_context", create)
    with pytest.raises(MissingPartError):
        open_context()
    assert loaded == [torch_is_loaded]
