"""The command that installs what is missing, to be typed as it is where the user stands.

Rule: it fits the way this Trilane was installed, and nobody is sent to a package index for Trilane: none has it.
"""

from __future__ import annotations

import importlib.metadata
import re
import shlex
import sys
from collections.abc import Iterator
from pathlib import Path

PACKAGE = Path(__file__).resolve().parent
#: Where no distribution lists them: a folder that was copied without its pyproject.toml.
UNKNOWN = "(the packages that Trilane's pyproject.toml lists)"
#: EGL and a software OpenGL driver, on Debian and Ubuntu.
EGL_LINE = "apt-get install libegl1 libgl1-mesa-dri"


def clone() -> Path | None:
    """The folder of the source tree that this Trilane runs from, also by an editable install; None for a wheel's."""
    root = PACKAGE.parents[1]
    return root if PACKAGE.parent.name == "src" and (root / "pyproject.toml").is_file() else None


def pip() -> str:
    """The command that runs the pip of this Python; relative when the user stands in the clone whose .venv this is."""
    root = clone()
    if root is None or Path(sys.prefix).resolve() != root / ".venv":
        return f"{shlex.quote(sys.executable)} -m pip"
    return ".venv/bin/pip" if _stands_in(root) else shlex.quote(str(root / ".venv/bin/pip"))


def package_line(name: str) -> str:
    """The command that installs the package `name` of a package index."""
    return f"{pip()} install {name}"


def install_line(extra: str = "") -> str:
    """The command that installs the packages of an `extra` of Trilane; without one, those that every run needs."""
    root = clone()
    if root is not None:
        source = ("." if _stands_in(root) else str(root)) + (f"[{extra}]" if extra else "")
        return f"{pip()} install -e {shlex.quote(source)}"
    packages = [shlex.quote(requirement) for requirement in _requirements(extra)] or [UNKNOWN]
    return f"{pip()} install {' '.join(packages)}"


def _stands_in(root: Path) -> bool:
    try:
        return Path.cwd() == root
    except FileNotFoundError:  # the working directory was removed
        return False


def _requirements(extra: str) -> Iterator[str]:
    """What the installed distribution requires for `extra` (for "": in any case), without the markers."""
    try:
        lines = importlib.metadata.requires("trilane") or []
    except importlib.metadata.PackageNotFoundError:
        return
    for line in lines:
        requirement, _, marker = line.partition(";")
        named = re.search(r"""extra\s*==\s*["']([\w.-]+)["']""", marker)
        if (named[1] if named else "") == extra:
            yield requirement.strip()
