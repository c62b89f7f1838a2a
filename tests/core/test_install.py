"""The command that installs what is missing fits the way Trilane was installed, and where the user stands."""

from __future__ import annotations

import ast
import importlib.metadata
import shlex
import subprocess
import sys
import tomllib
from collections.abc import Iterator
from pathlib import Path

import pytest

from trilane import errors
from trilane.errors import clone, install_line, package_line, pip
from trilane.stages.dsp.runtime import RUNTIMES

ROOT = Path(__file__).resolve().parents[2]
PYTHON = "/opt/my python/bin/python3"
REQUIRES = [
    "numpy>=1.26",
    "pyzmq>=26",
    'anny>=0.6; extra == "anny"',
    'torch>=2.6; extra == "anny"',
    "torch>=2.6; extra == 'train'",
    'iceoryx2>=0.7; python_version >= "3.11" and extra == "peers"',
    'tomli; python_version < "3.11"',
]


@pytest.fixture
def from_clone(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A clone with its .venv, whose Python is the one that runs; the user stands elsewhere."""
    root = tmp_path / "trilane"
    (root / "src" / "trilane").mkdir(parents=True)
    (root / "pyproject.toml").touch()
    monkeypatch.setattr(errors, "PACKAGE", root / "src" / "trilane")
    monkeypatch.setattr(sys, "prefix", str(root / ".venv"))
    monkeypatch.setattr(sys, "executable", str(root / ".venv/bin/python"))
    monkeypatch.chdir(tmp_path)
    return root


@pytest.fixture
def from_wheel(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(errors, "PACKAGE", tmp_path / "lib" / "python3.11" / "site-packages" / "trilane")
    monkeypatch.setattr(sys, "executable", PYTHON)
    monkeypatch.setattr(importlib.metadata, "requires", lambda name: REQUIRES if name == "trilane" else None)


def test_where_the_user_stands_decides_the_words(from_clone: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert install_line("anny") == f"{from_clone}/.venv/bin/pip install -e '{from_clone}[anny]'"
    assert install_line() == f"{from_clone}/.venv/bin/pip install -e {from_clone}"
    monkeypatch.chdir(from_clone)
    assert install_line("anny") == ".venv/bin/pip install -e '.[anny]'"
    assert install_line() == ".venv/bin/pip install -e ."
    assert package_line("onnxruntime") == ".venv/bin/pip install onnxruntime"
    assert RUNTIMES["cuda"].install() == (
        ".venv/bin/pip uninstall -y onnxruntime && .venv/bin/pip install onnxruntime-gpu  "
        "# on a machine with an NVIDIA GPU"
    )
    (from_clone / "gone").mkdir()
    monkeypatch.chdir(from_clone / "gone")
    (from_clone / "gone").rmdir()
    assert install_line("fit") == f"{from_clone}/.venv/bin/pip install -e '{from_clone}[fit]'"
    monkeypatch.setattr(sys, "prefix", "/opt/other")  # an environment that is not the clone's own
    monkeypatch.setattr(sys, "executable", "/opt/other/bin/python")
    assert install_line("fit") == f"/opt/other/bin/python -m pip install -e '{from_clone}[fit]'"


def test_a_clone_whose_path_has_a_space(from_clone: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    spaced = from_clone.rename(from_clone.with_name("my trilane"))
    monkeypatch.setattr(errors, "PACKAGE", spaced / "src" / "trilane")
    monkeypatch.setattr(sys, "prefix", str(spaced / ".venv"))
    assert shlex.split(install_line("fit")) == [f"{spaced}/.venv/bin/pip", "install", "-e", f"{spaced}[fit]"]


@pytest.mark.usefixtures("from_wheel")
def test_from_a_wheel_an_extra_is_its_packages() -> None:
    assert clone() is None
    assert pip() == f"'{PYTHON}' -m pip"
    assert install_line("anny") == f"'{PYTHON}' -m pip install 'anny>=0.6' 'torch>=2.6'"
    assert install_line("train") == f"'{PYTHON}' -m pip install 'torch>=2.6'"
    assert install_line("peers") == f"'{PYTHON}' -m pip install 'iceoryx2>=0.7'"
    assert install_line() == f"'{PYTHON}' -m pip install 'numpy>=1.26' 'pyzmq>=26' tomli"
    assert package_line("onnxruntime") == f"'{PYTHON}' -m pip install onnxruntime"


@pytest.mark.usefixtures("from_wheel")
def test_a_package_without_a_distribution_still_says_something(monkeypatch: pytest.MonkeyPatch) -> None:
    def missing(name: str) -> list[str]:
        raise importlib.metadata.PackageNotFoundError(name)

    monkeypatch.setattr(importlib.metadata, "requires", missing)
    assert install_line("anny") == f"'{PYTHON}' -m pip install (the packages that Trilane's pyproject.toml lists)"


def extras_named(file: Path) -> Iterator[str]:
    """What is given to `install_line(...)`, `partial(install_line, ...)` and `MissingPartError(extra=...)`."""
    for node in ast.walk(ast.parse(file.read_text())):
        if not isinstance(node, ast.Call) or not isinstance(node.func, ast.Name):
            continue
        given = [arg.value for arg in node.args if isinstance(arg, ast.Constant)]
        if node.func.id == "install_line" or "install_line" in [getattr(arg, "id", "") for arg in node.args]:
            yield from given
        if node.func.id == "MissingPartError":
            yield from (ast.literal_eval(word.value) for word in node.keywords if word.arg == "extra")


def test_every_extra_that_is_named_is_one() -> None:
    assert clone() == ROOT
    extras = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["optional-dependencies"]
    folders = [folder for folder in (ROOT / "src" / "trilane").iterdir() if folder.is_dir()]
    named = {extra for folder in folders for file in folder.rglob("*.py") for extra in extras_named(file)}
    assert {"anny", "fit", "loadgen", "openvino", "peers", "plot", "qnn", "train"} <= named <= set(extras)


#: Refuses what only extras install, then imports modules of commands that a plain install has.
WITHOUT_EXTRAS = """
import sys
class Refuses:
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] in {"scipy", "torch", "skimage", "flip_evaluator", "starlette", "matplotlib"}:
            raise ModuleNotFoundError(name, name=name)
sys.meta_path.insert(0, Refuses())
import trilane.apps.avatar_files, trilane.apps.inspect.inspect_file, trilane.apps.run.run_job
import trilane.apps.compare.pages, trilane.apps.explain.explained_run, trilane.apps.predict.asked_file
"""


def test_commands_of_a_plain_install_need_no_extra() -> None:
    done = subprocess.run([sys.executable, "-c", WITHOUT_EXTRAS], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
