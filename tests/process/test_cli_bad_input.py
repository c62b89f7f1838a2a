"""Bad input on the command line: exit code 2, one sentence that names it, and nothing left behind."""

from __future__ import annotations

import json
import shutil
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import onnx
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


def huge_npy(path: Path) -> None:
    """A header that announces a petabyte."""
    with path.open("wb") as file:
        header = {"descr": "<f8", "fortran_order": False, "shape": (10**12, WIDTH)}
        np.lib.format.write_array_header_1_0(file, header)


def truncated_npy(path: Path) -> None:
    np.save(path, np.zeros((FRAMES, WIDTH)))
    path.write_bytes(path.read_bytes()[:-100])


def pickled_npy(path: Path) -> None:
    np.save(path, np.array([{"pose": 1}], dtype=object), allow_pickle=True)


MOTIONS: dict[str, tuple[str, Callable[[Path], None] | None, str]] = {
    "missing": ("m.npy", None, "no such file"),
    "unknown ending": ("m.txt", lambda path: path.write_text("1 2 3") and None, "the ending '.txt'"),
    "empty": ("m.npy", lambda path: path.touch(), "an empty file"),
    "truncated": ("m.npy", truncated_npy, "truncated"),
    "wrong shape": ("m.npy", lambda path: np.save(path, np.zeros((FRAMES, 7))), "7"),
    "no frames": ("m.npy", lambda path: np.save(path, np.zeros((0, WIDTH))), "0"),
    "pickled": ("m.npy", pickled_npy, "pickled"),
    "not a number": ("m.npy", lambda path: np.save(path, np.full((FRAMES, WIDTH), np.nan)), "not finite"),
    "text": ("m.npy", lambda path: np.save(path, np.full((FRAMES, WIDTH), "x")), "dtype"),
    "huge": ("m.npy", huge_npy, "bytes"),
    "no archive": ("m.npz", lambda path: path.write_bytes(b"PK\x03\x04 cut") and None, "no readable .npz"),
    "no BVH": ("m.bvh", lambda path: path.write_text("HIERARCHY\nROOT Hips\n{\n") and None, "line"),
}


@pytest.mark.parametrize("case", MOTIONS)
def test_a_bad_motion(case: str, tmp_path: Path, refused: Refused) -> None:
    name, make, said = MOTIONS[case]
    if make is not None:
        make(tmp_path / name)
    refused(["--motion", name], name, said)


CAMERAS = {
    "missing": (None, "no such file"),
    "empty": ("", "an empty file"),
    "wrong columns": ("1 2 3\n4 5 6\n", "3 columns"),
    "no rotation": (
        "0.0 1 0 0 0 0 1 0 0 0 0 1 0\n0.1 1 0 0 0 0 1 0 0 0 0 0 0\n" + "0.2 0 0 0 0 0 0 0 0 0 0 0 0\n" * 2,
        "first: line 2",
    ),
    "not a number": ("nan nan nan nan nan nan nan nan\n" * 3, "c.txt"),
}


@pytest.mark.parametrize("case", CAMERAS)
def test_a_bad_camera(case: str, tmp_path: Path, refused: Refused) -> None:
    text, said = CAMERAS[case]
    if text is not None:
        (tmp_path / "c.txt").write_text(text)
    refused(["--camera", "c.txt"], "c.txt", said)


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


def test_a_background_that_is_no_picture(tmp_path: Path, refused: Refused) -> None:
    (tmp_path / "b.png").write_bytes(b"\x89PNG\r\n\x1a\n and then nothing")
    refused(["--background", "b.png"], "b.png", "no readable picture")


def float_network(folder: Path) -> str:
    value = onnx.helper.make_tensor_value_info
    ends = [value(name, onnx.TensorProto.FLOAT, [1, 64, 64, 4]) for name in ("in", "out")]
    node = onnx.helper.make_node("Identity", ["in"], ["out"])
    graph = onnx.helper.make_graph([node], "floats", ends[:1], ends[1:])
    name = json.loads((folder / "manifest.json").read_text())["network"]["file"]
    onnx.save(onnx.helper.make_model(graph), folder / name)
    return name


def short_body(folder: Path) -> str:
    arrays = dict(np.load(folder / "body.npz"))
    arrays["weights"] = arrays["weights"][:, :54]
    np.savez(folder / "body.npz", **arrays)
    return "body.npz"


def damaged_manifest(folder: Path) -> str:
    (folder / "manifest.json").write_text("{")
    return "manifest.json"


def escaping_manifest(folder: Path) -> str:
    manifest = json.loads((folder / "manifest.json").read_text())
    (folder / "manifest.json").write_text(json.dumps({**manifest, "body": "/etc/passwd"}))
    return "manifest.json"


AVATARS: dict[str, tuple[Callable[[Path], str], str]] = {
    "network of floats": (float_network, "FLOAT"),
    "body of 54 joints": (short_body, "54"),
    "damaged manifest": (damaged_manifest, "manifest"),
    "file outside the bundle": (escaping_manifest, "outside the bundle"),
}


@pytest.mark.parametrize("case", AVATARS)
def test_a_bad_avatar(case: str, tiny_bundle: Path, tmp_path: Path, refused: Refused) -> None:
    shutil.copytree(tiny_bundle, tmp_path / "avatar")
    spoil, said = AVATARS[case]
    refused(["--avatar", "avatar"], spoil(tmp_path / "avatar"), said)


@pytest.mark.parametrize("place", ["taken", "file/run", "/proc/run", "a" * 300])
def test_a_place_that_cannot_be_written(place: str, tiny_bundle: Path, tmp_path: Path, refused: Refused) -> None:
    (tmp_path / "taken").mkdir()
    (tmp_path / "file").write_text("a file")
    refused(["--avatar", str(tiny_bundle), "--out", place], place, "choose another --out")
