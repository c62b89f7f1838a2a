"""The wheel carries whatever the package folders hold."""

from __future__ import annotations

import importlib.metadata
import subprocess
import tomllib
from fnmatch import fnmatch
from pathlib import Path

import pytest

import trilane

ROOT = Path(__file__).resolve().parents[2]
LINKS = sorted(path for path in (ROOT / "src" / "trilane").iterdir() if path.is_symlink())


def tracked() -> list[Path]:
    """Files under version control, relative to the root."""
    if not (ROOT / ".git").exists():
        pytest.skip("not a git checkout")
    done = subprocess.run(["git", "ls-files"], cwd=ROOT, capture_output=True, text=True, check=True)
    return [Path(line) for line in done.stdout.splitlines()]


def test_every_package_folder_is_linked_into_the_namespace_and_typed() -> None:
    folders = {path.parts[0] for path in tracked() if path.name == "__init__.py" and path.parts[0] != "src"}
    assert {link.name for link in LINKS} == folders
    for link in LINKS:
        assert link.resolve() == ROOT / link.name
        assert (link / "py.typed").is_file()


def test_every_data_file_has_an_ending_that_is_packed_and_is_in_a_folder_that_is() -> None:
    """Folders without `__init__.py` are packed too, unless `namespaces` is false; none with a dot in its name is."""
    settings = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
    patterns = settings["tool"]["setuptools"]["package-data"]["*"]
    assert settings["tool"]["setuptools"]["packages"]["find"].get("namespaces", True)
    names = {link.name for link in LINKS}
    for path in (path for path in tracked() if path.parts[0] in names):
        assert path.suffix == ".py" or any(fnmatch(path.name, pattern) for pattern in patterns), path
        assert not any("." in folder.name for folder in path.parents), path


def test_the_version_is_the_distributions(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(importlib.metadata, "version", lambda name: f"that of {name}")
    assert trilane.__version__ == "that of trilane"

    def absent(name: str) -> str:
        raise importlib.metadata.PackageNotFoundError(name)

    monkeypatch.setattr(importlib.metadata, "version", absent)
    assert trilane.__version__ == "0.0.0"
    with pytest.raises(AttributeError, match="module 'trilane' has no attribute 'other'"):
        trilane.other  # noqa: B018
