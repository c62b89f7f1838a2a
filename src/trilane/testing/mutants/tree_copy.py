"""A copy of the tree to put faults into. Rule: the tree itself never changes; the copy goes when the work ends."""

from __future__ import annotations

import os
import shutil
import subprocess
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from queue import SimpleQueue
from tempfile import TemporaryDirectory

from trilane.testing.mutants.fault import Fault


def tracked_files(root: Path) -> list[str]:
    """Every file that git knows or would take, relative to the tree. Raises CalledProcessError outside a checkout."""
    words = ["git", "ls-files", "--cached", "--others", "--exclude-standard"]
    listed = subprocess.run(words, cwd=root, capture_output=True, text=True, check=True).stdout.splitlines()
    return sorted(path for path in listed if (root / path).is_symlink() or (root / path).is_file())


class TreeCopy:
    """`root`: the copy's folder; what runs there imports the copy's modules, as Python, whatever is installed."""

    def __init__(self, root: Path) -> None:
        self.root = root
        self.temporary = root.parent / "t"  # short, since the paths of sockets may have 108 bytes
        self.temporary.mkdir()

    def environment(self) -> dict[str, str]:
        """For a process that runs in the copy. Threads are few: several trials run at a time."""
        return {
            **os.environ,
            "PYTHONPATH": str(self.root / "src"),
            "PYTHONDONTWRITEBYTECODE": "1",
            "TMPDIR": str(self.temporary),
            "OMP_NUM_THREADS": "1",
        }

    @contextmanager
    def with_fault(self, fault: Fault) -> Iterator[None]:
        """While inside, the file has the fault. Raises ValueError when the lines are not there."""
        file = self.root / fault.path
        text = file.read_text(encoding="utf-8")
        file.write_text(fault.put_into(text), encoding="utf-8")
        try:
            yield
        finally:
            file.write_text(text, encoding="utf-8")

    def clean(self) -> None:
        """Remove what a trial has left in its temporary folder."""
        shutil.rmtree(self.temporary, ignore_errors=True)
        self.temporary.mkdir()


@contextmanager
def copied_tree(root: Path, paths: Sequence[str], name: str = "tree") -> Iterator[TreeCopy]:
    """A copy of the files `paths` of `root` in a folder `name`, no checkout for git, with the real inputs beside it."""
    with TemporaryDirectory(prefix="trilane-copy-") as folder:
        copy = Path(folder) / name
        for path in paths:
            (copy / path).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy2(root / path, copy / path, follow_symlinks=False)
        shared = root.parent / "shared"
        if shared.is_dir():
            (Path(folder) / "shared").symlink_to(shared)
        yield TreeCopy(copy)


class FreeCopies:
    """Copies that several threads take in turn."""

    def __init__(self, trees: Sequence[TreeCopy]) -> None:
        self._free: SimpleQueue[TreeCopy] = SimpleQueue()
        for tree in trees:
            self._free.put(tree)

    @contextmanager
    def taken(self) -> Iterator[TreeCopy]:
        """Waits until one is free."""
        tree = self._free.get()
        try:
            yield tree
        finally:
            self._free.put(tree)
