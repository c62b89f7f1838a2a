"""`trilane run` of pipeline files: the folder that it leaves, and what reads that folder."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import av
import numpy as np
import onnx
import pytest
from onnx import TensorProto, helper, numpy_helper

import trilane
from trilane.apps.explain.explained_run import explain_run
from trilane.errors import BadInputError
from trilane.stages.dsp.runtime import installed

pytestmark = pytest.mark.usefixtures("no_new_process")
Cli = Callable[..., subprocess.CompletedProcess[str]]

FILE = """
[run]
fps = 60
latency_to = "overlay"
[units]
npu = { hardware = "dsp" }
[stages]
camera   = { block = "video", unit = "cpu", path = "street.mp4", size = "64x48" }
small    = { block = "prepare", unit = "cpu", in = "camera", like = "edges" }
edges    = { onnx = "edges.onnx", unit = "npu", in = "small" }
slow     = { python = "own:spot", unit = "gpu", in = "camera", out = { boxes = "f32 1x5" }, every = 3 }
video    = { block = "encode", unit = "cpu", in = "overlay", path = "out.mp4" }
[stages.overlay]
block = "overlay"
unit = "gpu"
in = { frame = "camera", mask = "edges", boxes = { from = "slow", sync = "latest" } }
"""
OWN = """
import numpy as np
def spot(settings):
    return lambda picture: np.array([[8, 8, 40, 40, picture.mean() + 1]], np.float32)
"""


#: Every second picture goes round the stage that inverts the others.
ROUND = """
[run]
fps = 60
[stages]
camera = { block = "video", unit = "cpu", path = "street.mp4", size = "64x48" }
odd    = { python = "own:odd", unit = "gpu", in = "camera", out = "u8 48x64x3", bypass = "video" }
invert = { python = "own:invert", unit = "dsp", in = "odd", out = "u8 48x64x3" }
video  = { block = "encode", unit = "cpu", in = "invert", path = "out.mp4" }
"""
OWN_ROUND = """
class Odd:
    def __init__(self):
        self.count, self.skips, self.was_told = 0, False, False
    def forget(self):
        self.was_told = True
    def __call__(self, picture):
        assert self.was_told, "before the first frame"
        self.skips = self.count % 2 == 1
        self.count += 1
        return picture
def odd(settings):
    return Odd()
def invert(settings):
    return lambda picture: 255 - picture
"""


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A pipeline file, its network, its code, and a video of 30 pictures."""
    with av.open(str(tmp_path / "street.mp4"), "w") as container:
        stream = container.add_stream("libx264", rate=30)
        stream.width, stream.height, stream.pix_fmt = 64, 48, "yuv420p"
        for number in range(30):
            shown = np.zeros((48, 64, 3), np.uint8)
            shown[:, number : number + 20] = 200
            container.mux(stream.encode(av.VideoFrame.from_ndarray(shown, format="rgb24")))
        container.mux(stream.encode())
    kernel = np.zeros((2, 3, 3, 3), np.float32)
    kernel[1, :, 1, 0], kernel[1, :, 1, 2] = -1, 1
    graph = helper.make_graph(
        [helper.make_node("Conv", ["x", "w"], ["y"], pads=[1, 1, 1, 1])],
        "g",
        [helper.make_tensor_value_info("x", TensorProto.FLOAT, [1, 3, 32, 32])],
        [helper.make_tensor_value_info("y", TensorProto.FLOAT, [1, 2, 32, 32])],
        [numpy_helper.from_array(kernel, "w")],
    )
    onnx.save(
        helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=8), tmp_path / "edges.onnx"
    )
    (tmp_path / "own.py").write_text(OWN)
    (tmp_path / "street.toml").write_text(FILE)
    return tmp_path


@pytest.fixture
def cli(folder: Path) -> Cli:
    def run(*arguments: str) -> subprocess.CompletedProcess[str]:
        return subprocess.run(
            [sys.executable, "-m", "trilane", *arguments],
            cwd=folder,
            env={**os.environ, "PYTHONDONTWRITEBYTECODE": "1"},
            capture_output=True,
            text=True,
            timeout=120,
            check=False,
        )

    return run


def test_a_run_of_a_file_leaves_a_folder_that_everything_reads(cli: Cli, folder: Path) -> None:
    """The video has 30 pictures at 30 a second: at 60 a second, a run of it has 60 frames."""
    done = cli("run", "street.toml", "--out", "first", "--json")
    assert done.returncode == 0, done.stderr
    assert f"own code: own of {folder} is imported and run" in " ".join(done.stderr.split())
    report = json.loads(done.stdout)
    assert report == json.loads((folder / "first" / "report.json").read_text())
    assert report["frames"]["presented"] == 60 and report["frames"]["requested"] == 60
    assert {name: row["jobs"] for name, row in report["stages"].items()} == {
        **dict.fromkeys(("camera", "small", "edges", "overlay", "video"), 60),
        "slow": 20,
    }
    assert report["streams"]["slow"]["age_ms"]["mean"] > 0
    assert report["config"]["pipeline"]["stages"]["slow"]["python"] == "own:spot"
    assert {file.name for file in (folder / "first").iterdir()} == {
        *("report.json", "journal.msgpack", "events.jsonl", "trace.pftrace", "video.mp4", "contact.png")
    }
    assert (folder / "out.mp4").read_bytes() == (folder / "first" / "video.mp4").read_bytes()
    with av.open(str(folder / "out.mp4")) as video:
        pictures = [frame.to_ndarray(format="rgb24") for frame in video.decode(video=0)]
    assert len(pictures) == 60
    assert pictures[40][20, 8].tolist() == pytest.approx([255, 220, 0], abs=40), "the left side of the box"
    loaded = trilane.load_run(folder / "first")
    assert loaded.frames()["frame"].tolist() == list(range(60))
    assert len(loaded.jobs) == sum(row["jobs"] for row in report["stages"].values())
    explained = explain_run(folder / "first", 3).as_json()
    assert sum(row["ms"] for row in explained["budget"]) == pytest.approx(report["frame_time_ms"]["mean"], rel=1e-3)
    again = cli("run", "street.toml", "--out", "second", "--frames", "60")
    assert again.returncode == 0, again.stderr
    compared = cli("compare", "first", "second", "--json")
    assert compared.returncode == 0, compared.stderr
    assert cli("explain", "first").returncode == 0


@pytest.mark.parametrize(
    ("change", "code", "said"),
    [
        (("own:spot", "own:none"), 2, "stages.slow.python: found no function 'none' in own"),
        (("own:spot", "absent:spot"), 2, "stages.slow.python: found no module 'absent'"),
        (("f32 1x5", "f32 2x5"), 1, "stages.slow: its code returned f32 1x5 for port boxes, expected f32 2x5"),
        (
            (', out = { boxes = "f32 1x5" }', ""),
            2,
            "stages.slow.out: found nothing, expected the type of what it writes",
        ),
        (("street.mp4", "absent.mp4"), 2, "absent.mp4: found no"),
        (('block = "prepare"', "time_ms = 3"), 2, "found"),
    ],
)
def test_a_file_that_cannot_be_run_says_which_stage_and_why(
    change: tuple[str, str], code: int, said: str, cli: Cli, folder: Path
) -> None:
    (folder / "street.toml").write_text(FILE.replace(*change))
    done = cli("run", "street.toml", "--out", "run", "--frames", "5")
    assert done.returncode == code, done.stderr
    assert said in " ".join(done.stderr.split())
    if code == 2:  # else a frame may have been presented before
        assert not (folder / "run").exists()


@pytest.mark.parametrize("option", ["--size=128", "--no-video", "--check=3"])
def test_options_of_a_scene_are_refused_by_name(option: str, cli: Cli, folder: Path) -> None:
    done = cli("run", "street.toml", option)
    assert done.returncode == 2
    assert option.partition("=")[0].removeprefix("--no-").removeprefix("--") in done.stderr
    assert not (folder / "runs").exists()


def test_options_stand_for_keys_of_the_file(cli: Cli) -> None:
    done = cli(
        "run", "street.toml", "--frames", "4", "--fps", "20", "--policy", "sequential", "--edge", "fifo:3", "--json",
        "--set", "stages.slow.every=2,stages.overlay.unit=screen",
    )  # fmt: skip
    report = json.loads(done.stdout)
    assert (report["policy"], report["edge"], report["frames"]["requested"]) == ("sequential", "fifo:3", 4)
    assert report["config"]["scene"]["fps"] == 20
    assert (report["stages"]["slow"]["jobs"], report["stages"]["overlay"]["unit"]) == (2, "screen")
    assert report["options"]["changes"] == ["stages.slow.every=2,stages.overlay.unit=screen"]


def test_frames_go_round_a_stage_that_has_nothing_to_do(cli: Cli, folder: Path) -> None:
    """Own code that counts its calls sends pictures 1, 3, 5 ... round: 30 of 60, and no call came before the run."""
    (folder / "own.py").write_text(OWN_ROUND)
    (folder / "street.toml").write_text(ROUND)
    done = cli("run", "street.toml", "--out", "round", "--json")
    assert done.returncode == 0, done.stderr
    report = json.loads(done.stdout)
    assert {name: row["jobs"] for name, row in report["stages"].items()} == {
        **dict.fromkeys(("camera", "odd", "video"), 60),
        "invert": 30,
    }
    assert (report["frames"]["presented"], report["frames"]["skipped"]) == (60, 30)
    with av.open(str(folder / "out.mp4")) as video:
        means = [frame.to_ndarray(format="gray").mean() for frame in video.decode(video=0)]
    assert [mean > 128 for mean in means] == [number % 2 == 0 for number in range(60)]
    assert cli("explain", "round").returncode == 0


def test_a_load_sends_the_frames_of_its_pattern_round_here_and_in_a_prediction(cli: Cli, folder: Path) -> None:
    (folder / "street.toml").write_text(
        "[run]\nframes = 50\n[stages]\n"
        'a = { block = "busy", unit = "cpu", load_ms = 1, bypass = { to = "c", pattern = "01101" } }\n'
        'b = { block = "busy", unit = "gpu", in = "a", load_ms = 2 }\n'
        'c = { block = "busy", unit = "cpu", in = "b", load_ms = 1 }\n'
    )
    run = json.loads(cli("run", "street.toml", "--json").stdout)
    predicted = json.loads(cli("predict", "street.toml", "--json").stdout)["pipelines"][0]
    for report in (run, predicted):
        assert {name: row["jobs"] for name, row in report["stages"].items()} == {"a": 50, "b": 20, "c": 50}
        assert report["frames"]["skipped"] == 30


def test_a_program_runs_a_file_as_the_command_does(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Also in another runtime, which computes the same edges."""
    monkeypatch.chdir(folder)
    done = trilane.run("street.toml", frames=6, runtime="openvino" if "openvino" in installed() else "ort", out="api")
    assert (done.report.frames.presented, done.folder) == (6, folder / "api")
    with pytest.raises(BadInputError, match="--check with a pipeline file"):
        trilane.run("street.toml", check=2)
    with pytest.raises(BadInputError, match="--set without a pipeline file"):
        trilane.run("default", changes=("run.fps=3",))
