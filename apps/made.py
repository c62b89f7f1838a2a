"""When, by which command line and by which Trilane something was made.

Rule: what is not known is null; nothing here can make a command fail.
"""

from __future__ import annotations

import subprocess
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from trilane import machine
from trilane.stages.machine_facts import package_version

CHECKOUT = Path(__file__).resolve().parents[1]
GIT_S = 5.0


def made_facts(command: Sequence[str], checkout: Path = CHECKOUT) -> dict[str, Any]:
    """The keys of `trilane.apps.report.Made`, as of now.

    `command`: the command line, word by word.
    `checkout`: the folder above Trilane's own, a checkout of git or not.
    """
    revision, modified = _revision(checkout)
    return {
        "at": machine.here.now().isoformat(timespec="seconds"),
        "command": list(command),
        "trilane": package_version("trilane"),
        "revision": revision,
        "modified": modified,
    }


def _revision(checkout: Path) -> tuple[str | None, bool | None]:
    """Git's revision and whether files that git follows were changed; None for what is no checkout of its own."""
    git = machine.here.program("git")
    if git is None or not (checkout / ".git").exists():
        return None, None
    revision = _git(git, checkout, "rev-parse", "HEAD")
    changes = _git(git, checkout, "status", "--porcelain", "--untracked-files=no")
    return revision, None if revision is None or changes is None else bool(changes)


def _git(git: str, checkout: Path, *words: str) -> str | None:
    """What git answers, None when it cannot. It may not lock the index: others may work in the checkout."""
    command = [git, "--no-optional-locks", "-C", str(checkout), *words]
    try:
        done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=GIT_S)
    except (OSError, subprocess.TimeoutExpired):
        return None
    return done.stdout.strip() if done.returncode == 0 else None
