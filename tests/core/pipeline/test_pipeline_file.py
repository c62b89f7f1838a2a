"""Pipeline files: what is read from them, and what the scheduler gets."""

from __future__ import annotations

import os
import random
import threading
from pathlib import Path

import numpy as np
import pytest

from support.pipeline_files import BRANCHES, CUT, DEPTH, STREET, write_file
from trilane.errors import BadInputError
from trilane.pipeline.file_graph import edge_rules, graph_of, settings_of
from trilane.pipeline.pipeline_file import is_pipeline_file, read_pipeline
from trilane.scheduler.events import Graph, Input, StageSpec
from trilane.scheduler.period_bound import period_bound

MS = 1_000_000


def test_the_street(tmp_path: Path) -> None:
    file = read_pipeline(write_file(tmp_path, STREET))
    assert list(file.stages) == ["camera", "small", "detector", "crop", "segmenter", "overlay", "video"]
    assert [file.hardware(unit) for unit in ("cpu", "npu", "gpu")] == ["cpu", "dsp", "gpu"]
    assert file.latency_to == "video"
    assert file.readers["camera"] == ["small", "crop", "overlay"]
    crop = file.stages["crop"]
    assert [(each.port, each.stage) for each in crop.inputs] == [("frame", "camera"), ("boxes", "detector")]
    assert crop.out is not None
    assert (crop.out["picture"].shape, crop.out["picture"].payload_bytes) == ((256, 256, 3), 256 * 256 * 3)
    settings = settings_of(file)
    assert (settings.frames, settings.policy, settings.period_ns) == (1000, "pipelined", 33_333_333)


def test_the_branches(tmp_path: Path) -> None:
    file = read_pipeline(write_file(tmp_path, BRANCHES))
    graph = graph_of(file, dict.fromkeys(file.readers, "double"))
    detector = Input("detector", latest=True, max_age_ns=250 * MS)
    assert graph.stages[3] == StageSpec("detector", "dsp", (Input("frame"),), 3)
    assert graph.stages[4] == StageSpec("tracker", "cpu", (Input("frame"), detector))
    assert (graph.latency_to, graph.from_release) == ("composite", True)
    assert settings_of(file, frames=7, hang_ns=3).frames == 7


def test_a_row_of_stages_is_a_chain(tmp_path: Path) -> None:
    """So it takes the steps of a chain, and a file without a rate has a source that is always ready."""
    file = read_pipeline(write_file(tmp_path, CUT))
    graph = graph_of(file, edge_rules(file))
    assert graph == Graph((StageSpec("head", "gpu"), StageSpec("tail", "dla")), ("double",), "tail")
    assert settings_of(file).period_ns == 0


def test_stages_come_after_what_they_read_and_else_in_the_order_of_the_file(tmp_path: Path) -> None:
    text = """
    [stages]
    z = { unit = "u", in = { a = "y", b = "a" }, time_ms = 1 }
    b = { unit = "u", in = "a", time_ms = 1 }
    y = { unit = "u", time_ms = 1 }
    a = { unit = "u", time_ms = 1 }
    """
    assert list(read_pipeline(write_file(tmp_path, text)).stages) == ["y", "a", "z", "b"]


def test_two_ports_of_one_stage_are_one_stream(tmp_path: Path) -> None:
    text = """
    [stages]
    det = { unit = "u", time_ms = 1, out = { boxes = "f32 32x5", scores = "f32 32" } }
    best = { unit = "v", in = { boxes = "det.boxes", scores = "det.scores" }, time_ms = 1 }
    """
    file = read_pipeline(write_file(tmp_path, text))
    assert [each.from_port for each in file.stages["best"].inputs] == ["boxes", "scores"]
    assert graph_of(file, edge_rules(file)).is_chain


def test_rules_of_streams_by_file_run_and_default(tmp_path: Path) -> None:
    def rules(head: str, tail: str = "") -> dict[str, str]:
        return edge_rules(read_pipeline(write_file(tmp_path, head + DEPTH + tail)))

    assert rules("") == dict.fromkeys(("frame", "depth", "seg"), "double")
    assert rules('[run]\nedge = "single"') == dict.fromkeys(("frame", "depth", "seg"), "single")
    assert rules('[run]\nedge = "single"', '[edges]\ndepth = "triple"')["depth"] == "triple"


def test_slots_where_branches_meet(tmp_path: Path) -> None:
    """By equal times: the street's camera is held by six stages. By real times its short stages need fewer."""
    file = read_pipeline(write_file(tmp_path, STREET))
    assert edge_rules(file) == {
        "camera": "fifo:6",
        **dict.fromkeys(("small", "detector", "crop", "segmenter", "overlay"), "double"),
    }
    times = {"camera": 1, "small": 1, "detector": 20, "crop": 1, "segmenter": 2, "overlay": 2, "video": 1}
    *some, last = [f"stages.{name}.time_ms={ms}" for name, ms in times.items()]
    assert edge_rules(file.changed(some))["camera"] == "fifo:6"  # as one is unknown
    assert edge_rules(file.changed([*some, last]))["camera"] == "double"  # held for 27 of 2 x 22


@pytest.mark.parametrize("seed", range(30))
def test_slots_by_equal_times_do_for_any_times(tmp_path: Path, seed: int) -> None:
    """A graph of nine stages without times: whatever they turn out to be, more slots gain nothing."""
    rng = random.Random(seed)
    rows = ["[stages]"]
    for place in range(9):
        sources = rng.sample(range(place), min(place, rng.choice((1, 2, 3))))
        ports = ", ".join(f'p{each} = "s{each}"' for each in sources)
        reads = f", in = {{ {ports} }}" if sources else ""
        rows.append(f's{place} = {{ python = "m:f", unit = "u{rng.randrange(6)}"{reads} }}')
    file = read_pipeline(write_file(tmp_path, "\n".join(rows)))
    graph = graph_of(file, edge_rules(file))
    most = graph_of(file, dict.fromkeys(file.readers, "fifo:64"))
    for _ in range(5):
        times = {name: rng.choice((0, 1, 2, 30, 100)) for name in file.stages}
        assert period_bound(graph, times).period_ns == period_bound(most, times).period_ns


def test_the_arrivals_of_a_seed(tmp_path: Path) -> None:
    text = '[run]\narrivals = { poisson = 500 }\n[stages]\na = { unit = "u", time_ms = 1 }'
    file = read_pipeline(write_file(tmp_path, text))
    first, again, other = (settings_of(file, 20_000, seed).arrivals_ns for seed in (3, 3, 4))
    assert first == again != other
    gaps = np.diff(np.array(first)) / MS
    assert abs(gaps.mean() - 2) < 3 * 2 / np.sqrt(len(gaps))
    assert abs((gaps > 2).mean() - np.exp(-1)) < 0.02


def test_other_values_are_a_variant_of_the_file(tmp_path: Path) -> None:
    file = read_pipeline(write_file(tmp_path, DEPTH))
    changed = file.changed(["stages.seg.unit=b", "run.fps=50", "stages.depth.time_ms={ mean = 3, sd = 1 }"])
    assert (changed.stages["seg"].unit, changed.run.fps) == ("b", 50)
    time = changed.stages["depth"].time_ms
    assert time is not None
    assert (time.mean_ms, time.sd) == (3, 1)
    assert file.stages["seg"].unit == "c"
    with pytest.raises(BadInputError, match=r"stages.seg.uni: found the unknown key 'uni'.*did you mean 'unit'"):
        file.changed(["stages.seg.uni=b"])
    with pytest.raises(BadInputError, match=r"stages.depth.time_ms: found '\[\[.*, expected a time in ms"):
        file.changed([f"stages.depth.time_ms={'[' * 5000}"])
    with pytest.raises(BadInputError, match=r"--set: found 'seg=b', expected KEY=VALUE"):
        file.changed(["seg=b"])


@pytest.mark.parametrize(
    ("unit", "is_right"),
    [
        ("isp", True),
        ("npu2", True),
        ("gpu1", True),
        ("tpu", True),
        ("cpu_big", True),
        ("neurral", False),
        ("gppu", False),
    ],
)
def test_units_exist_by_being_named_but_for_slips(tmp_path: Path, unit: str, is_right: bool) -> None:
    text = f"""
    [units]
    npu = {{ hardware = "dsp" }}
    neural = {{}}
    [stages]
    a = {{ unit = "{unit}", time_ms = 1 }}
    """
    path = write_file(tmp_path, text)
    if is_right:
        assert list(read_pipeline(path).units) == [unit]
        return
    with pytest.raises(BadInputError, match=r"stages.a.unit: found the unknown unit .* did you mean"):
        read_pipeline(path)
    path.write_text(text.replace("[stages]", f"{unit} = {{}}\n[stages]"))
    assert list(read_pipeline(path).units) == [unit]


def test_a_scene_is_no_pipeline_file(tmp_path: Path) -> None:
    (tmp_path / "scene.toml").write_text('motion = "walk.bvh"\n[camera]\nwidth = 3\n')
    assert not is_pipeline_file(tmp_path / "scene.toml")
    assert not is_pipeline_file(tmp_path / "none.toml")
    for number, head in enumerate(("[stages]", " [ stages.a ]", '["stages"]', "stages.a = {}", "stages = 3")):
        assert is_pipeline_file(write_file(tmp_path, head, f"{number}.toml"))


@pytest.mark.parametrize("source", ["camera", "small", "overlay"])
def test_a_block_has_one_port_without_a_name(tmp_path: Path, source: str) -> None:
    reader = f'more = {{ block = "discard", unit = "cpu", in = "{source}.nope" }}'
    with pytest.raises(BadInputError, match=rf"stages\.more\.in: found the unknown port 'nope' of {source}"):
        read_pipeline(write_file(tmp_path, f"{STREET}\n{reader}\n"))


def test_a_deviation_far_above_the_mean_is_refused(tmp_path: Path) -> None:
    text = '[stages]\na = { unit = "u", time_ms = { mean = 1e-300, sd = 1 } }'
    with pytest.raises(BadInputError, match=r"stages\.a\.time_ms: found sd = 1 beside mean = 1e-300"):
        read_pipeline(write_file(tmp_path, text))


def test_a_pipe_is_no_pipeline_file(tmp_path: Path) -> None:
    """It is not opened: nobody may ever write to it."""
    os.mkfifo(tmp_path / "pipe.toml")
    writer = threading.Timer(5, (tmp_path / "pipe.toml").write_text, ["[stages]"])
    writer.daemon = True
    writer.start()
    assert not is_pipeline_file(tmp_path / "pipe.toml")
    writer.cancel()
