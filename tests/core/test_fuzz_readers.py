"""The readers of people's files, fed with changed files: a few seconds here, ten minutes by the module itself."""

from __future__ import annotations

from pathlib import Path
from random import Random

import pytest

from support import fuzz_readers
from support.fuzz_readers import Fuzzer, findings
from support.mutations import CHANGES, mutated
from support.small_inputs import write_small_inputs
from trilane.errors import BadInputError

CASES = 240


def tried(folder: Path, seed: int, seconds: float, count: int | None = None) -> str:
    """The findings, a line each."""
    return "\n".join(map(str, findings(Fuzzer(folder, seed), seconds, count=count)))


def test_a_few_changed_files(tmp_path: Path) -> None:
    assert tried(tmp_path, seed=1, seconds=20, count=CASES) == ""


@pytest.mark.slow
@pytest.mark.timeout(400)
@pytest.mark.parametrize("seed", [11, 12])
def test_many_changed_files(tmp_path: Path, seed: int) -> None:
    assert tried(tmp_path, seed, seconds=60) == ""


def test_a_number_finds_a_case_again(tmp_path: Path) -> None:
    for name, path in write_small_inputs(tmp_path).items():
        if path.is_file():
            content = path.read_bytes()
            again = [mutated(content, path.suffix, Random(f"7 {k}")) for k in range(20)]
            assert again == [mutated(content, path.suffix, Random(f"7 {k}")) for k in range(20)], name
            assert len(set(again)) > 10, name
    assert {".bvh", ".npy", ".npz", ".json", ".onnx", ".toml", ".txt"} <= CHANGES.keys()


def failing(path: Path) -> None:
    raise KeyError(path.name)


def leaving(path: Path) -> None:
    (path.parent / "left.txt").write_text("x")


def holding(path: Path) -> None:
    HELD.append(next(file for file in (path, *path.glob("*")) if file.is_file()).open("rb"))


def hiding(path: Path) -> None:
    raise BadInputError("a file", path.suffix, "something else")


def inner(path: Path) -> None:
    raise BadInputError(path, "list index out of range", "a file")


HELD: list[object] = []
BAD = {
    "Traceback": failing,
    "left names": leaving,
    "left files": holding,
    "does not name the file": hiding,
    "about Python": inner,
}


@pytest.mark.parametrize("said", BAD)
def test_each_defect_is_a_finding(said: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    fuzzer = Fuzzer(tmp_path, 1)
    monkeypatch.setattr(fuzz_readers, "READERS", dict.fromkeys(fuzz_readers.READERS, BAD[said]))
    found = [finding for finding in fuzzer.case(0) if said in finding.what]
    for file in HELD:
        file.close()  # type: ignore[attr-defined]
    HELD.clear()
    assert found
    assert str(found[0]).startswith("--seed 1 --first 0 (")
