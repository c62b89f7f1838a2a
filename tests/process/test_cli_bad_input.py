"""Bad input on the command line: exit code 2, one sentence that names it, and nothing left behind."""

from __future__ import annotations

import shutil
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import psutil
import pytest

from trilane.apps.cli.main import main

SHM = Path("/dev/shm")  # noqa: S108 - looked at, never written
FRAMES, WIDTH = 4, 165


def listing(folder: Path) -> list[Path]:
    return sorted(folder.rglob("*"))


def shared_memory() -> list[Path]:
    """What a Python program would leave in /dev/shm; other programs come and go there."""
    return sorted(path for pattern in ("*trilane*", "psm_*") for path in SHM.glob(pattern))


Refused = Callable[[list[str], str, str], None]


@pytest.fixture
def refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Refused:
    """`trilane run` in `tmp_path` ends with 2 and one line that names and says it, and leaves everything as it was."""
    monkeypatch.chdir(tmp_path)

    def run(arguments: list[str], named: str, said: str) -> None:
        before = listing(tmp_path), shared_memory(), psutil.Process().children(recursive=True)
        monkeypatch.setattr(sys, "argv", ["trilane", "run", *arguments, "--json"])
        with pytest.raises(SystemExit) as left:
            main()
        out, err = capsys.readouterr()
        assert (left.value.code, out) == (2, "")
        lines = [line for line in err.splitlines() if line.startswith("error: ")]
        assert len(lines) == 1, err
        assert named in lines[0] and said in lines[0]
        assert "Traceback" not in err
        assert (listing(tmp_path), shared_memory(), psutil.Process().children(recursive=True)) == before

    return run


def truncated_npy(path: Path) -> None:
    np.save(path, np.zeros((FRAMES, WIDTH)))
    path.write_bytes(path.read_bytes()[:-100])


#: One file of a kind; `tests/core/test_malformed_files.py` has what else may be wrong with each.
FILES: dict[str, tuple[str, str, Callable[[Path], object], str]] = {
    "no motion": ("--motion", "m.npy", lambda _: None, "no such file"),
    "a truncated motion": ("--motion", "m.npy", truncated_npy, "truncated"),
    "a camera of three columns": ("--camera", "c.txt", lambda path: path.write_text("1 2 3\n4 5 6\n"), "3 columns"),
    "a background that is no picture": (
        "--background",
        "b.png",
        lambda path: path.write_bytes(b"\x89PNG\r\n\x1a\n and then nothing"),
        "no readable picture",
    ),
}


@pytest.mark.parametrize("case", FILES)
def test_a_bad_file(case: str, tmp_path: Path, refused: Refused) -> None:
    option, name, make, said = FILES[case]
    make(tmp_path / name)
    refused([option, name], name, said)


OPTIONS = {
    "no frames": (["--frames", "0"], "frames", "found 0"),
    "odd size": (["--size", "100"], "size", "multiple of 32"),
    "huge size": (["--size", "999999968"], "size", "32 to 4096"),
    "no rate": (["--fps", "0"], "fps", "found 0"),
    "a misspelt edge": (["--edge", "tripel"], "--edge", "found 'tripel', expected single, double, triple, fifo:N or"),
    "too long a queue": (["--edge", "fifo:65"], "--edge", "found 'fifo:65', expected fifo:N with N from 1 to 64"),
    "an output without height": (["--picture", "640"], "--picture", "expected WIDTHxHEIGHT in pixels, such as 640x480"),
    "an odd output": (["--picture", "641x480"], "output.width", "found 641, expected a multiple of 2"),
    "a huge output": (
        ["--picture", "640x4098"],
        "output.height",
        "found 4098, expected a multiple of 2 from 64 to 4096",
    ),
    "unknown scene": (["beach"], "scene", "default"),
    "unknown runtime": (["--runtime", "abacus"], "runtime", "'abacus'"),
    "unknown skinning": (["--skinning", "npu"], "--skinning", "'npu'"),
    "a split without a unit": (["--split", "rgba"], "--split", "UNIT one of cpu, gpu, dsp"),
    "a split nowhere": (["--split", "nowhere=cpu"], "network.onnx, cut", "'nowhere'"),
    "a split at a chip's pace": (
        ["--pace", "--profile", "snapdragon-888", "--split", "rgba_QuantizeLinear_Output=cpu"],
        "options",
        "--split with --pace",
    ),
    "a core that is not there": (["--cores", "dsp=0,4099"], "--cores", "core 4099 for unit dsp"),
    "cores of no unit": (["--cores", "npu=0"], "--cores", "unknown unit 'npu'"),
    "cores twice": (["--cores", "dsp=0", "--cores", "dsp=0"], "--cores", "unit dsp twice"),
    "no cores": (["--cores", "dsp="], "--cores", "UNIT=LIST"),
    "pace of no chip": (["--pace"], "options", "--pace without --profile"),
    "chip without pace": (["--profile", "snapdragon-888"], "options", "--profile without --pace"),
    "unknown chip": (["--profile", "abacus", "--pace"], "abacus", "expected"),
    "no slow motion": (["--profile", "snapdragon-888", "--pace", "--slow-motion", "0"], "--slow-motion", "found 0"),
    "slow motion alone": (["--slow-motion", "3"], "options", "--slow-motion without --pace"),
    "two caps": (
        ["--profile", "snapdragon-888", "--pace", "--performance-profile", "burst"],
        "options",
        "--performance-profile with --pace",
    ),
    "no motion": (["--motion", ""], "--motion", "found an empty path, expected a file or a folder"),
    "unknown motion": (["--motion", "builtin:fly"], "motion", "builtin:fly"),
    "unknown camera": (["--camera", "builtin:fly"], "camera", "builtin:fly"),
    "missing background": (["--background", "b.mp4"], "b.mp4", "no such file"),
    "missing avatar": (["--avatar", "nobody"], "nobody", "no such folder"),
}


@pytest.mark.parametrize("case", OPTIONS)
def test_a_bad_option(case: str, refused: Refused) -> None:
    refused(*OPTIONS[case])


def test_a_bad_avatar(tiny_bundle: Path, tmp_path: Path, refused: Refused) -> None:
    shutil.copytree(tiny_bundle, tmp_path / "avatar")
    (tmp_path / "avatar" / "manifest.json").write_text("{")
    refused(["--avatar", "avatar"], "manifest.json", "manifest")


@pytest.mark.parametrize("place", ["taken", "file/run", "/proc/run", "a" * 300])
def test_a_place_that_cannot_be_written(place: str, tiny_bundle: Path, tmp_path: Path, refused: Refused) -> None:
    (tmp_path / "taken").mkdir()
    (tmp_path / "file").write_text("a file")
    refused(["--avatar", str(tiny_bundle), "--out", place], place, "choose another --out")
