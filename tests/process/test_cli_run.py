"""`trilane run` as a person runs it: real units in real processes around a tiny network.

The tiny network's pictures mean nothing; what is tested is what the command leaves and says.
"""

from __future__ import annotations

import json
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import av
import numpy as np
import psutil
import pytest
from PIL import Image

from trilane import machine
from trilane.apps.run.report import read_report
from trilane.avatars.bundle import load_bundle
from trilane.avatars.network_split import cuts
from trilane.pipeline.fork_server import process_name
from trilane.units import COMPUTED, NO_FIGURES, UNITS

FRAMES = 20
PATIENCE_S = 60.0
WHOLE = {"report.json", "video.mp4", "contact.png", "trace.pftrace", "events.jsonl", "journal.msgpack"}


def command(bundle: Path, *arguments: str) -> list[str]:
    base = [sys.executable, "-m", "trilane.apps.cli.main", "run", "--avatar", str(bundle), "--size", "64x64"]
    return [*base, "--json", *arguments]


def run(bundle: Path, folder: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(command(bundle, *arguments), cwd=folder, capture_output=True, text=True, check=False)


def wait_until(condition: object, what: str) -> None:
    end = time.monotonic() + PATIENCE_S
    while not condition():  # type: ignore[operator]
        assert time.monotonic() < end, f"waited {PATIENCE_S} s for {what}"
        time.sleep(0.05)


def presented_something(folder: Path) -> bool:
    return any(path.stat().st_size > 5000 for path in folder.glob("*.partial/segments/*.mp4"))


@contextmanager
def running(bundle: Path, folder: Path) -> Iterator[tuple[subprocess.Popen[str], list[psutil.Process]]]:
    """A long run that has presented frames, and the processes of its units."""
    cores = [word for unit in UNITS for word in ("--cores", f"{unit}={min(machine.here.cores())}")]
    arguments = command(bundle, "--frames", "100000", "--out", "run", *cores)  # asked for, so that none are tried
    with subprocess.Popen(arguments, cwd=folder, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as parent:
        try:
            wait_until(lambda: presented_something(folder) or parent.poll() is not None, "frames")
            assert parent.poll() is None, parent.communicate()
            yield parent, psutil.Process(parent.pid).children(recursive=True)
        finally:
            parent.kill()


@pytest.fixture(scope="module")
def finished(
    drawable_bundle: Path, tmp_path_factory: pytest.TempPathFactory
) -> tuple[Path, subprocess.CompletedProcess[str]]:
    """The folder in which a run was made, and what the command said."""
    folder = tmp_path_factory.mktemp("run")
    done = run(drawable_bundle, folder, "--frames", str(FRAMES), "--baseline", "10")
    assert done.returncode == 0, done.stderr
    return folder, done


Finished = tuple[Path, subprocess.CompletedProcess[str]]


def test_parts_of_the_network_are_stages_of_their_own_with_the_same_pictures(
    finished: Finished, drawable_bundle: Path, tmp_path: Path
) -> None:
    whole = json.loads(finished[1].stdout)
    places = [cut.at for cut in cuts(load_bundle(str(drawable_bundle)).read_network())]
    split = ("--split", f"{places[1]}=cpu", "--split", f"{places[-2]}=dsp")
    done = run(drawable_bundle, tmp_path, "--frames", str(FRAMES), "--baseline", "0", *split)
    assert done.returncode == 0, done.stderr
    report = json.loads(done.stdout)
    assert list(report["stages"]) == ["pose", "raster", "infer", "infer-2", "infer-3", "composite", "present"]
    assert [report["stages"][name]["unit"] for name in ("infer", "infer-2", "infer-3")] == ["dsp", "cpu", "dsp"]
    assert report["frames"]["presented"] == FRAMES
    assert report["checksum"] == whole["checksum"]


def run_folder(finished: Finished) -> Path:
    (folder,) = (finished[0] / "runs").iterdir()
    return folder


def test_the_run_folder_is_whole_stdout_is_the_report_and_stderr_says_where_it_is(finished: Finished) -> None:
    folder, done = run_folder(finished), finished[1]
    assert {path.name for path in folder.iterdir()} == WHOLE
    assert [path.name for path in finished[0].iterdir()] == ["runs"]
    assert json.loads(done.stdout) == json.loads((folder / "report.json").read_text())
    assert str(folder) in done.stderr
    assert "Traceback" not in done.stderr


def test_the_report_says_what_was_asked_for(finished: Finished) -> None:
    report = read_report(run_folder(finished))
    assert report.clock == "host"
    assert (report.frames.requested, report.frames.presented, report.frames.lost) == (FRAMES, FRAMES, 0)
    assert set(report.pids) == {"cpu", "gpu", "dsp"}
    assert len(set(report.pids.values())) == 3
    assert report.baseline is not None
    assert report.baseline.frames.presented == 10
    assert report.machine.gl is not None
    assert report.machine.gl.renderer
    assert report.machine.cpu.cores_allowed
    assert report.accuracy["tiny"].keys() == {"source", "changed", "why"}, "never validated: nothing is made up"
    assert report.sources["accuracy.tiny"] == NO_FIGURES
    assert all(report.stage_metrics["present"][key] > 0 for key in ("digest_ms", "encode_ms"))
    assert report.bytes is not None and all(stage.bytes is not None for stage in report.stages.values())
    assert report.bytes.all == pytest.approx(sum(stage.bytes.all for stage in report.stages.values() if stage.bytes))
    assert {report.sources[f"{key}.least"] for key in ("bytes", "stages.infer.bytes")} == {COMPUTED}


def test_the_video_has_every_frame_and_the_sheet_shows_it(finished: Finished) -> None:
    folder = run_folder(finished)
    with av.open(str(folder / "video.mp4")) as container:
        pictures = [frame.to_ndarray(format="rgb24") for frame in container.decode(video=0)]
    assert len(pictures) == FRAMES
    assert all(picture.shape == (480, 640, 3) for picture in pictures)
    assert min(float(picture.std()) for picture in pictures) > 5, "a room is no plain colour"
    assert not np.array_equal(pictures[0], pictures[-1]), "the camera moves"
    with Image.open(folder / "contact.png") as sheet:
        assert sheet.size == (4 * 320, 5 * 240)


def test_two_runs_present_the_same_bytes(finished: Finished, drawable_bundle: Path, tmp_path: Path) -> None:
    done = run(drawable_bundle, tmp_path, "--frames", str(FRAMES), "--policy", "sequential")
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout)["checksum"] == json.loads(finished[1].stdout)["checksum"]


def test_recorded_motion_and_camera(drawable_bundle: Path, shared_data: Path, tmp_path: Path) -> None:
    motion, camera = shared_data / "motion" / "cmu_jumping_jacks.bvh", shared_data / "camera" / "arkit_camera_pose.txt"
    arguments = ["--motion", str(motion), "--camera", str(camera), "--frames", "12", "--baseline", "0"]
    done = run(drawable_bundle, tmp_path, *arguments)
    assert done.returncode == 0, done.stderr
    report = json.loads(done.stdout)
    assert (report["frames"]["presented"], report["frames"]["lost"], report["baseline"]) == (12, 0, None)
    for word in ("BVH", "ARKit"):
        assert word in done.stderr, "each load says what it took the file for"


def test_an_interrupted_run_keeps_its_frames_and_ends_its_units(drawable_bundle: Path, tmp_path: Path) -> None:
    with running(drawable_bundle, tmp_path) as (parent, units):
        parent.send_signal(signal.SIGINT)
        out, err = parent.communicate(timeout=PATIENCE_S)
        assert parent.returncode == 130, err
    assert json.loads(out)["interrupted"]
    assert {path.name for path in (tmp_path / "run").iterdir()} == WHOLE
    assert [path.name for path in tmp_path.iterdir()] == ["run"]
    assert psutil.wait_procs(units, timeout=PATIENCE_S)[1] == []


def test_a_killed_run_leaves_nothing_that_looks_whole(drawable_bundle: Path, tmp_path: Path) -> None:
    with running(drawable_bundle, tmp_path) as (parent, units):
        assert len(units) >= 3
        parent.kill()
    assert psutil.wait_procs(units, timeout=PATIENCE_S)[1] == [], "the units end with their parent"
    assert [path.suffix for path in tmp_path.iterdir()] == [".partial"]


def test_a_killed_unit_is_restarted_and_its_video_goes_on(drawable_bundle: Path, tmp_path: Path) -> None:
    with running(drawable_bundle, tmp_path) as (parent, units):
        victim = next(unit for unit in units if unit.name() == process_name("cpu"))
        victim.kill()
        wait_until(lambda: len(list(tmp_path.glob("*.partial/segments/*.mp4"))) == 2, "a second segment")
        second = max(tmp_path.glob("*.partial/segments/*.mp4"))
        wait_until(lambda: second.stat().st_size > 5000, "frames after the restart")
        parent.send_signal(signal.SIGINT)
        out, err = parent.communicate(timeout=PATIENCE_S)
    report = json.loads(out)
    assert report["units"]["cpu"]["restarts"] == 1
    assert "restart" in err or "unexpectedly" in err
    assert report["video"]["frames"] >= report["frames"]["presented"] - 1, (
        "short of the last frame before the kill at most"
    )
