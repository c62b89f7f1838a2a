"""A file is written whole or not at all, and what stood there before survives a failure."""

from __future__ import annotations

import os
import stat
import subprocess
import sys
from pathlib import Path

import pytest

from trilane.errors import BadInputError
from trilane.writing import require_writable, write_atomically, write_bytes, write_folder

BIG = 1 << 20
WRITERS, TIMES = 4, 25
#: Writes 1 MiB of its letter again and again, and prints every temporary name.
WRITE_OFTEN = """
import sys
from pathlib import Path
from trilane.writing import write_atomically
letter, times, size = map(int, sys.argv[2:])
for _ in range(times):
    with write_atomically(Path(sys.argv[1])) as draft:
        print(draft.name)
        draft.write_bytes(bytes([letter]) * size)
"""


def names(folder: Path) -> list[str]:
    return sorted(item.name for item in folder.iterdir())


def test_the_file_is_there_when_the_block_ends(tmp_path: Path) -> None:
    path = tmp_path / "a.npz"
    with write_atomically(path) as draft:
        assert not draft.exists()
        assert (draft.parent, draft.suffix) == (tmp_path, ".npz")
        draft.write_bytes(b"new")
        assert not path.exists()
    assert path.read_bytes() == b"new"
    assert names(tmp_path) == ["a.npz"]


@pytest.mark.parametrize("error", [KeyboardInterrupt(), ValueError("no"), BadInputError("x", "y", "z"), SystemExit(3)])
def test_a_failure_leaves_what_was_there_and_nothing_else(tmp_path: Path, error: BaseException) -> None:
    path = tmp_path / "a.bin"
    path.write_bytes(b"old")
    with pytest.raises(type(error)) as raised, write_atomically(path) as draft:
        draft.write_bytes(b"half")
        raise error
    assert raised.value is error
    assert path.read_bytes() == b"old"
    assert names(tmp_path) == ["a.bin"]


def test_the_mode_is_that_of_any_new_file(tmp_path: Path) -> None:
    before = os.umask(0o027)
    try:
        write_bytes(tmp_path / "a", b"1")
    finally:
        os.umask(before)
    assert stat.S_IMODE((tmp_path / "a").stat().st_mode) == 0o640


def test_no_folder_is_one_sentence(tmp_path: Path) -> None:
    path = tmp_path / "none" / "a"
    with pytest.raises(BadInputError) as raised:
        write_bytes(path, b"1", "give another --out")
    said = f"{path}: found no such file or directory, expected a place that can be written; give another --out"
    assert str(raised.value) == said


@pytest.mark.parametrize("name", ["folder", "", "x" * 256, "file/below"])
def test_a_place_where_no_file_can_be(tmp_path: Path, name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "folder").mkdir()
    (tmp_path / "file").touch()
    with pytest.raises(BadInputError, match="expected a place that can be written"):
        write_bytes(Path(name), b"1")
    assert names(tmp_path) == ["file", "folder"]


def test_an_error_about_another_file_stays_what_it_is(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match="input"), write_atomically(tmp_path / "a") as draft:
        draft.write_bytes((tmp_path / "input").read_bytes())
    with pytest.raises(FileNotFoundError, match="input"), write_folder(tmp_path / "folder") as folder:
        (folder / "a").write_bytes((tmp_path / "input").read_bytes())
    assert names(tmp_path) == []


def test_a_block_that_writes_nothing_is_a_failure(tmp_path: Path) -> None:
    with pytest.raises(BadInputError, match="no such file or directory"), write_atomically(tmp_path / "a"):
        pass
    assert names(tmp_path) == []


def test_a_pipe_is_written_and_not_replaced(tmp_path: Path) -> None:
    path = tmp_path / "pipe"
    os.mkfifo(path)
    reader = os.open(path, os.O_RDONLY | os.O_NONBLOCK)
    try:
        write_bytes(path, b"through")
        assert os.read(reader, 100) == b"through"
    finally:
        os.close(reader)
    assert stat.S_ISFIFO(path.stat().st_mode)
    assert names(tmp_path) == ["pipe"]


def test_a_place_is_checked_before_long_work(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """No file can be made beside a device, which is written itself."""
    require_writable(tmp_path / "a.csv")
    assert names(tmp_path) == []
    with pytest.raises(BadInputError, match="found is a directory, expected a place that can be written"):
        require_writable(tmp_path)
    with pytest.raises(BadInputError, match="found no such file or directory"):
        require_writable(tmp_path / "none" / "a.csv")
    monkeypatch.setattr("tempfile.TemporaryFile", lambda **_: pytest.fail("a file beside the pipe"))
    os.mkfifo(tmp_path / "pipe")
    require_writable(tmp_path / "pipe")


def test_processes_that_write_the_same_file(tmp_path: Path) -> None:
    """The file is one of theirs, whole, at any moment; no two of them used the same temporary name."""
    path = tmp_path / "out" / "a"
    path.parent.mkdir()
    write_bytes(path, bytes(BIG))
    command = [sys.executable, "-c", WRITE_OFTEN, str(path)]
    writers = [
        subprocess.Popen([*command, *map(str, (number, TIMES, BIG))], stdout=subprocess.PIPE, text=True)
        for number in range(1, WRITERS + 1)
    ]
    torn = 0
    while any(writer.poll() is None for writer in writers):
        content = path.read_bytes()
        torn += content != content[:1] * BIG
    used = [line for writer in writers for line in writer.communicate()[0].splitlines()]
    assert [writer.returncode for writer in writers] == [0] * WRITERS
    assert torn == 0
    assert len(set(used)) == len(used) == WRITERS * TIMES
    assert path.read_bytes()[0] in range(1, WRITERS + 1)
    assert names(path.parent) == ["a"]


def test_the_files_of_a_folder_take_their_places_together(tmp_path: Path) -> None:
    folder = tmp_path / "made" / "bundle"
    with write_folder(folder) as draft:
        (draft / "a").write_text("1")
        (draft / "b").write_text("1")
        assert not folder.exists()
    (folder / "own").write_text("stays")
    with write_folder(folder) as draft:
        (draft / "a").write_text("2")
        assert (folder / "a").read_text() == "1"
    assert {name: (folder / name).read_text() for name in names(folder)} == {"a": "2", "b": "1", "own": "stays"}
    assert names(folder.parent) == ["bundle"]


def test_a_folder_that_fails_is_as_it_was(tmp_path: Path) -> None:
    folder = tmp_path / "bundle"
    folder.mkdir()
    (folder / "a").write_text("old")
    with pytest.raises(ValueError, match="no"), write_folder(folder) as draft:
        (draft / "a").write_text("new")
        raise ValueError("no")
    assert (folder / "a").read_text() == "old"
    assert names(tmp_path) == ["bundle"]


def test_a_file_where_the_folder_should_be(tmp_path: Path) -> None:
    (tmp_path / "bundle").touch()
    with pytest.raises(BadInputError, match="found file exists"), write_folder(tmp_path / "bundle") as draft:
        (draft / "a").write_text("new")
    assert names(tmp_path) == ["bundle"]
