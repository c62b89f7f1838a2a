"""The cache never decides anything: damaged, missing or not writable, what it holds is made again."""

from __future__ import annotations

import errno
import os
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from trilane import cache
from trilane.cache import cached_arrays

SOURCE = np.arange(6, dtype=np.float32)
DAMAGE: dict[str, Callable[[bytes], bytes]] = {
    "empty": lambda content: content[:0],
    "first 100 bytes": lambda content: content[:100],
    "all but the last byte": lambda content: content[:-1],
    "half": lambda content: content[: len(content) // 2],
    "zeros in the middle": lambda content: content[:200] + bytes(400) + content[600:],
    "noise": lambda content: bytes(range(256)) * (len(content) // 256 + 1),
    "an .npy file": lambda content: b"\x93NUMPY\x01\x00" + content,
    "a pickle": lambda content: b"\x80\x04N." + content,
}


class Maker:
    """Counts how often it had to make the arrays."""

    def __init__(self) -> None:
        self.calls = 0

    def __call__(self) -> dict[str, np.ndarray]:
        self.calls += 1
        return {"twice": 2 * SOURCE, "noise": np.random.default_rng(1).integers(0, 256, 2000, dtype=np.uint8)}


@pytest.fixture(autouse=True)
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    return tmp_path / "trilane" / "arrays"


def asked(make: Maker, source: np.ndarray = SOURCE, name: str = "double 1") -> None:
    arrays = cached_arrays(name, [source], make)
    assert set(arrays) == {"twice", "noise"}  # what was stored and no more
    assert np.array_equal(arrays["twice"], [0, 2, 4, 6, 8, 10])


def test_made_once_for_the_same_sources(folder: Path) -> None:
    make = Maker()
    asked(make)
    asked(make)
    assert make.calls == 1
    assert len(list(folder.iterdir())) == 1


@pytest.mark.parametrize("name,source", [("double 2", SOURCE), ("double 1", SOURCE + 1), ("double 1", SOURCE[:, None])])
def test_made_again_for_another_name_value_or_shape(name: str, source: np.ndarray) -> None:
    make = Maker()
    asked(make)
    asked(make, source, name)
    assert make.calls == 2


def test_each_name_and_source_has_an_entry_of_its_own(folder: Path) -> None:
    """`ab` and `c` are not `a` and `bc`, nor is a name a source; how an array lies in memory does not count."""
    turned = np.arange(6).reshape(2, 3).T
    sources: list[tuple[str, list[np.ndarray | str]]] = [
        *(("n", ["ab", "c"]), ("n", ["a", "bc"]), ("n", ["abc"]), ("nab", ["c"]), ("n", [])),
        *(("n", [np.zeros(shape, kind)]) for shape in (2, (2, 1)) for kind in (np.int32, np.float32)),
        *(("n", [np.ones(2, np.int32)]), ("n", [turned])),
    ]
    for name, given in [*sources, ("n", [turned.copy()])]:
        cached_arrays(name, given, Maker())
    assert len(list(folder.iterdir())) == len(sources)


@pytest.mark.parametrize("damage", DAMAGE)
def test_a_damaged_entry_is_made_again_and_replaced(folder: Path, damage: str) -> None:
    make = Maker()
    asked(make)
    (entry,) = folder.iterdir()
    entry.write_bytes(DAMAGE[damage](entry.read_bytes()))
    asked(make)
    assert make.calls == 2
    asked(make)
    assert make.calls == 2, "the entry was left damaged"


def test_a_pipe_in_the_place_of_an_entry_is_neither_read_nor_written(folder: Path) -> None:
    make = Maker()
    asked(make)
    (entry,) = folder.rglob("*.npz")
    entry.unlink()
    os.mkfifo(entry)
    asked(make)
    assert make.calls == 2 and entry.is_fifo()


def test_a_full_disk_keeps_nothing_and_loses_nothing(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(*_arguments: object, **_arrays: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(cache.np, "savez", full)
    make = Maker()
    asked(make)
    asked(make)
    assert make.calls == 2
    assert list(folder.iterdir()) == []


def test_a_cache_folder_that_cannot_be_made(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "file").write_text("not a folder")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "file"))
    asked(Maker())
    assert cache.cache_dir("openvino") is None


def test_the_cache_lies_in_the_home_of_who_has_no_other(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("XDG_CACHE_HOME")
    monkeypatch.setattr(Path, "home", lambda: tmp_path)
    assert cache.cache_dir("openvino") == tmp_path / ".cache" / "trilane" / "openvino"
    assert (tmp_path / ".cache" / "trilane" / "openvino").is_dir()

    def nobodys() -> Path:
        raise RuntimeError("Could not determine home directory.")

    monkeypatch.setattr(Path, "home", nobodys)
    assert cache.cache_dir("openvino") is None
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "other"))
    assert cache.cache_dir("openvino") == tmp_path / "other" / "trilane" / "openvino"
    monkeypatch.setattr(cache.os, "access", lambda _path, _mode: False)
    assert cache.cache_dir("openvino") is None


def test_a_cache_keeps_the_newest(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cache, "MAX_ENTRIES", 2)
    seen: list[set[str]] = []
    for number in range(4):
        cache.cached_arrays("told 1", [f"source {number}"], lambda: {"a": np.zeros(1)})
        for place, entry in enumerate(sorted(folder.iterdir(), key=lambda path: path.stat().st_mtime_ns)):
            os.utime(entry, (1000 + 10 * number + place, 1000 + 10 * number + place))
        seen.append({entry.name for entry in folder.iterdir()})
    assert [len(names) for names in seen] == [1, 2, 2, 2]
    assert seen[0] < seen[1] and not seen[0] & seen[3] and len(seen[1] & seen[2]) == 1
    assert all(name.endswith(".npz") and len(name) == 44 for names in seen for name in names)
