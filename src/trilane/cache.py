"""A cache of results that are expensive to compute. Rule: the cache saves time and never changes a result.

The cache lies under XDG_CACHE_HOME. The name of an entry is a digest of everything that the entry was made from. An
entry that cannot be read is made again. If the folder cannot be written, nothing is kept.
"""

from __future__ import annotations

import contextlib
import hashlib
import os
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from trilane import machine
from trilane.errors import BadInputError
from trilane.writing import write_atomically

ARRAYS = "arrays"
MAX_ENTRIES = 64  # entries of arrays, some MB each; the oldest are removed first

Arrays = Mapping[str, NDArray[Any]]


def cache_dir(name: str) -> Path | None:
    """Return the folder of the cache `name`, and make it if it is missing; None if it cannot be written."""
    try:
        folder = machine.here.cache_home() / "trilane" / name
        folder.mkdir(parents=True, exist_ok=True)
    except (OSError, RuntimeError):  # RuntimeError: this user has no home
        return None
    return folder if os.access(folder, os.W_OK) else None


def cache_entry(name: str, file: str) -> Path | None:
    """Return the path of `file` in the cache `name`; None if the cache cannot be written.

    Return None too if the path exists but is no file. It may be a pipe, and reading a pipe might wait for ever.
    """
    folder = cache_dir(name)
    if folder is None:
        return None
    entry = folder / file
    return entry if entry.is_file() or not entry.exists() else None


def cached_arrays(name: str, sources: Iterable[NDArray[Any] | str], make: Callable[[], Arrays]) -> Arrays:
    """Return the arrays by name, from the cache if they are there, else from `make`.

    `name`: name of the arrays, with a version number. The number must grow when the code of `make` changes.
    `sources`: everything from which `make` computes the arrays.
    `make`: function that computes the arrays.
    """
    entry = cache_entry(ARRAYS, f"{_digest(name, sources)}.npz")
    if entry is None:
        return make()
    if (stored := _read(entry)) is not None:
        return stored
    made = make()
    with contextlib.suppress(OSError, BadInputError):
        with write_atomically(entry) as draft, draft.open("wb") as file:
            np.savez(file, allow_pickle=False, **made)
        entries = sorted(entry.parent.glob("*.npz"), key=lambda path: path.stat().st_mtime)
        for oldest in entries[:-MAX_ENTRIES]:
            oldest.unlink(missing_ok=True)
    return made


def _read(entry: Path) -> Arrays | None:
    """Return the arrays in the file `entry`, by name; None if the file is missing or damaged in any way."""
    try:
        with entry.open("rb") as file, np.load(file, allow_pickle=False) as stored:
            return {key: stored[key] for key in stored.files}
    except Exception:
        return None


def _digest(name: str, sources: Iterable[NDArray[Any] | str]) -> str:
    digest = hashlib.blake2b(name.encode() + b"\0", digest_size=20)
    for source in sources:
        if isinstance(source, str):
            digest.update(source.encode() + b"\0")
        else:
            digest.update(f"{source.dtype.str}{source.shape}".encode())
            digest.update(np.ascontiguousarray(source).data)
    return digest.hexdigest()
