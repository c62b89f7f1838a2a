"""`trilane predict FILE.toml`: by hand, by queueing theory, and against a network by itself."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from math import sqrt
from pathlib import Path
from statistics import fmean, stdev
from types import SimpleNamespace
from typing import Any

import onnx
import pytest

from support.pipeline_files import BRANCHES, CUT, DEPTH, STREET, network, write_file
from support.run_folders import write_run
from support.run_report import make_report
from trilane.apps.cli.predict import _digits
from trilane.errors import BadInputError
from trilane.hw_profiles.application import Plan, Variant, simulated, stage_times_ms
from trilane.hw_profiles.pipeline_prediction import (
    MeasuredStages,
    given_price,
    measured_price,
    predict_file,
    prices_of,
    steady_ms,
)
from trilane.hw_profiles.profile_files import load_runnable
from trilane.hw_profiles.rates import FrameInterval, holding
from trilane.hw_profiles.reference_networks import NetworkSpec, reference_network
from trilane.hw_profiles.schema import corners_of
from trilane.pipeline.file_graph import edge_rules, graph_of
from trilane.pipeline.file_keys import StageTime
from trilane.pipeline.pipeline_file import checked_tables, read_pipeline
from trilane.scheduler.events import Settings
from trilane.scheduler.virtual import simulate
from trilane.units import SUSTAINED

Command = Callable[..., tuple[str, str]]
Predict = Callable[..., dict[str, Any]]


@pytest.fixture
def documents(command: Command, tmp_path: Path) -> Predict:
    """The document of `trilane predict` for a text, with further options."""
    return lambda text, *options: json.loads(command("predict", write_file(tmp_path, text), *options, "--json")[0])


@pytest.fixture
def predict(documents: Predict) -> Predict:
    """The first pipeline of that document."""
    return lambda text, *options: documents(text, *options)["pipelines"][0]


def chain(*times: str, head: str = "", tail: str = "") -> str:
    """A chain with a unit for each stage."""
    rows = [
        f's{place} = {{ unit = "u{place}", time_ms = {time}' + (f', in = "s{place - 1}" }}' if place else " }")
        for place, time in enumerate(times)
    ]
    return "\n".join([head, "[stages]", *rows, tail])


@pytest.mark.parametrize(
    ("head", "frame_ms", "first_ms"),
    [("", 14, 19), ('[run]\nedge = "single"', 17, 19), ("[run]\nin_flight = 1", 19, 19), ("[run]\nfps = 50", 20, 19)],
)
def test_a_join(predict: Predict, head: str, frame_ms: float, first_ms: float) -> None:
    answer, alone = predict(head + DEPTH), predict(head + DEPTH, "--frames", "1")
    times = answer["frame_time_ms"]
    assert (times["mean"], times["p50"], times["max"]) == (frame_ms, frame_ms, frame_ms)
    assert answer["period_ms"] == frame_ms
    assert answer["fps"] == pytest.approx(1e3 / frame_ms)
    assert alone["latency_ms"]["mean"] == first_ms


def test_a_paced_join_has_its_latency_for_every_frame(predict: Predict) -> None:
    answer = predict("[run]\nfps = 50\nframes = 300" + DEPTH)
    assert (answer["latency_ms"]["mean"], answer["latency_ms"]["max"]) == (19, 19)
    assert answer["frames"]["presented"] == 300
    assert answer["rate"]["sentence"] == "holds 50 fps: yes; 14 ms of 20 ms"


@pytest.mark.parametrize(
    ("head", "frame_ms"),
    [
        *(('[run]\nedge = "single"', 9), ('[run]\nedge = "double"', 5), ("[run]\nin_flight = 1", 15)),
        *(("[run]\nin_flight = 3", 5), ('[run]\npolicy = "sequential"', 15)),
    ],
)
def test_the_chain_of_five(predict: Predict, head: str, frame_ms: float) -> None:
    assert predict(chain("2", "3", "5", "4", "1", head=head))["frame_time_ms"]["mean"] == frame_ms


@pytest.mark.parametrize("edge", ["triple", "orphan", "double"])
def test_a_rate_holds_only_where_every_frame_is_shown(predict: Predict, edge: str) -> None:
    answer = predict(chain("2", "50", head=f'[run]\nfps = 30\nedge = "{edge}"'))
    assert answer["fps"] == pytest.approx(20, rel=1e-3)
    assert answer["rate"]["sentence"] == "holds 30 fps: no; 50 ms of 33.3 ms"


def test_slots_that_fill_do_not_make_a_pipeline_faster(predict: Predict) -> None:
    branches = 'a = { unit = "a", time_ms = 10 }\nb = { unit = "b", in = "a", time_ms = 11 }'
    latest = 'c = { unit = "c", time_ms = 1, in = { a = "a", b = { from = "b", sync = "latest" } } }'
    answer = predict(f'[run]\nfps = 95\n[stages]\n{branches}\n{latest}\n[edges]\na = "fifo:64"\nb = "fifo:3"')
    assert answer["needs_ms"]["mean"] == 11
    assert answer["rate"]["holds"] is False


TRACKED = """
[run]
frames = 999
latency_to = "{}"
{}
[stages]
source = {{ unit = "camera", time_ms = 0 }}
tracker = {{ unit = "npu", in = "source", time_ms = 12 }}
detector = {{ unit = "npu", in = "source", time_ms = 45, every = 3 }}
"""


def test_a_tracker_beside_a_detector_of_each_third_frame(predict: Predict) -> None:
    """Frame 0 takes 12; frame 1 waits for the detector until 57; frame 2 waits for that until 69."""
    third = 1e3 / 30
    tracker = predict(TRACKED.format("tracker", "fps = 30"))["latency_ms"]
    assert tracker["max"] == pytest.approx(57 - third + 12, abs=1e-5)
    assert tracker["p50"] == pytest.approx(69 - 2 * third + 12, abs=1e-5)
    assert tracker["mean"] == pytest.approx((12 + (69 - third) + (81 - 2 * third)) / 3, abs=1e-5)
    detector = predict(TRACKED.format("detector", "fps = 30"))["latency_ms"]
    assert (detector["samples"], detector["mean"], detector["max"]) == (333, 57, 57)
    fed = predict(TRACKED.format("tracker", ""))
    assert (fed["period_ms"], fed["cycle"]) == (27, ["tracker", "detector"])
    assert fed["duration_s"] == pytest.approx(999 * 27 / 1e3, rel=1e-3)


def test_the_published_cut(predict: Predict) -> None:
    """Jitter of the head does not reach the frame time, which is the tail's."""
    answer = predict(CUT)
    assert answer["period_ms"] == answer["frame_time_ms"]["p50"] == 1.1717
    assert answer["frame_time_ms"]["mean"] == pytest.approx(1.1717, rel=1e-4)
    head = answer["stages"]["head"]["service_ms"]
    assert head["mean"] == pytest.approx(1.1146, abs=3 * 0.02 / sqrt(1000))
    assert head["p90"] - head["p50"] == pytest.approx(0.02 * 1.2816, rel=0.15)


@pytest.mark.parametrize("slots", [1, 3])
def test_two_exponential_stages_have_the_throughput_of_theory(predict: Predict, slots: int) -> None:
    text = chain("{ exponential = 1 }", "{ exponential = 1 }", head=f'[run]\nedge = "fifo:{slots}"\nframes = 10000')
    times = [predict(text, "--seed", str(seed))["frame_time_ms"]["mean"] for seed in range(6)]
    assert abs(fmean(times) - (slots + 1) / slots) < 3 * stdev(times) / sqrt(len(times))


@pytest.mark.parametrize(("load", "wait_ms"), [(0.5, 0.5), (0.8, 2)])
def test_random_arrivals_wait_as_theory_says(predict: Predict, load: float, wait_ms: float) -> None:
    text = chain("1", head=f"[run]\narrivals = {{ poisson = {1e3 * load} }}\nframes = 10000")
    waits = [predict(text, "--seed", str(seed))["stages"]["s0"]["wait_ms"]["mean"] for seed in range(6)]
    assert abs(fmean(waits) - wait_ms) < 3 * stdev(waits) / sqrt(len(waits))


def test_a_full_queue_turns_away_as_many_as_theory_says(predict: Predict) -> None:
    """M/M/1/K at load 0.9: one in work, one that the unit holds ready and three that wait are K = 5."""
    text = chain("{ exponential = 1 }", head="[run]\narrivals = { poisson = 900 }\nin_queue = 3\nframes = 10000")
    runs = [predict(text, "--seed", str(seed))["frames"] for seed in range(6)]
    shares = [1 - run["presented"] / run["requested"] for run in runs]
    loss = (1 - 0.9) * 0.9**5 / (1 - 0.9**6)
    assert abs(fmean(shares) - loss) < 3 * stdev(shares) / sqrt(len(shares))


def test_samples_are_drawn_as_they_are(predict: Predict) -> None:
    row = predict(chain("{ samples = [1, 1, 4] }", head="[run]\nframes = 3000"))["stages"]["s0"]
    assert row["alone_ms"] == 2
    assert (row["service_ms"]["p50"], row["service_ms"]["max"]) == (1, 4)
    assert row["service_ms"]["mean"] == pytest.approx(2, abs=3 * sqrt(2) / sqrt(3000))


def test_a_mean_and_a_deviation_are_those_of_the_times(predict: Predict) -> None:
    """Also where they are alike: the logarithm then has the variance log 2, so the median is mean / sqrt 2."""
    times = predict(chain("{ mean = 2, sd = 2 }", head="[run]\nframes = 20000"))["stages"]["s0"]["service_ms"]
    assert times["mean"] == pytest.approx(2, abs=3 * 2 / sqrt(20000))
    assert times["p50"] == pytest.approx(sqrt(2), rel=0.03)


def test_ignorance_where_frames_are_dropped_comes_from_runs(tmp_path: Path) -> None:
    """An error of 1 % moves the time between shown frames little; it is not that between arrivals, 1.11."""
    head = "[run]\narrivals = { poisson = 900 }\nin_queue = 1\nframes = 4000"
    file = read_pipeline(write_file(tmp_path, chain("{ exponential = 1 }", head=head)))
    given = given_price(file, "s0")
    assert given is not None
    frame = predict_file(file, {"s0": replace(given, low_ms=0.99, high_ms=1.01)})["frame_time_ms"]
    assert 1.2 < 0.9 * frame["mean"] < frame["low"] < frame["mean"] < frame["high"] < 1.1 * frame["mean"]


def test_a_seed_says_all_and_given_times_leave_no_ignorance(predict: Predict) -> None:
    text = chain("{ mean = 2, sd = 1 }", "{ exponential = 2 }")
    first, again, other = predict(text), predict(text), predict(text, "--seed", "1")
    assert first == again
    assert first["frame_time_ms"]["mean"] != other["frame_time_ms"]["mean"]
    for times in (first["frame_time_ms"], first["latency_ms"]):
        assert times["low"] == times["high"] == times["mean"]


def test_a_variant_meets_the_same_luck(documents: Predict) -> None:
    """So a stage that nothing changes has the same times, frame by frame."""
    text = chain("{ mean = 2, sd = 1 }", "{ exponential = 2 }")
    rows = documents(text, "--set", "stages.s1.time_ms=1")["pipelines"]
    assert rows[0]["stages"]["s0"]["service_ms"] == rows[1]["stages"]["s0"]["service_ms"]


NETWORK = """
[stages]
seg = { onnx = "seg.onnx", unit = "UNIT", in = "frame" }
frame = { unit = "camera", time_ms = 0 }
"""


@pytest.mark.parametrize("unit", ["gpu", "dsp"])
def test_a_network_has_the_time_that_it_has_by_itself(
    command: Command, documents: Predict, tmp_path: Path, unit: str
) -> None:
    document = documents(NETWORK.replace("UNIT", unit), "--profile", "snapdragon-8-gen-3")
    row = document["pipelines"][0]["stages"]["seg"]
    options = ("--network", tmp_path / "seg.onnx", "--runtime", unit, "--profile", "snapdragon-8-gen-3", "--json")
    alone = json.loads(command("predict", *options)[0])["networks"][0]
    assert (row["alone_ms"], row["low_ms"], row["high_ms"]) == (alone["network_ms"], alone["low_ms"], alone["high_ms"])
    assert row["source"] == f"snapdragon-8-gen-3, {unit} in {alone['precision']}"
    frame = document["pipelines"][0]["frame_time_ms"]
    assert frame["mean"] == pytest.approx(alone["network_ms"], abs=1e-5)
    for end in ("low", "high"):
        assert frame[end] == pytest.approx(alone[f"{end}_ms"], abs=1e-5)
    assert document["machine"]["profile"] == "snapdragon-8-gen-3"


def test_this_machine_unmeasured_has_no_interval(documents: Predict) -> None:
    """Nothing measures its GPU, so its speeds are assumed, as for a network by itself."""
    text = "[run]\nfps = 1000" + NETWORK.replace("UNIT", "gpu")
    answer = documents(text, "--profile", "host")["pipelines"][0]
    for times in (answer["needs_ms"], answer["frame_time_ms"], answer["latency_ms"]):
        assert (times["low"], times["high"]) == (None, None)
    row, rate = answer["stages"]["seg"], answer["rate"]
    assert (row["low_ms"], rate["reserve_low"]) == (None, None)
    assert rate["sentence"].endswith("of 1 ms (no interval)")
    assert "assumed" in row["why"][0]


def test_a_time_of_the_file_overrides_the_networks_and_needs_no_chip(documents: Predict) -> None:
    text = NETWORK.replace("UNIT", "dsp").replace('in = "frame"', 'in = "frame", time_ms = 7')
    document = documents(text)
    row = document["pipelines"][0]["stages"]["seg"]
    assert (row["alone_ms"], row["source"], document["machine"]) == (7, "time_ms", None)


def test_precision_is_the_networks_the_files_or_that_of_the_option(documents: Predict) -> None:
    text = NETWORK.replace("UNIT", "dsp")

    def source(text: str, *options: str) -> str:
        return str(documents(text, *options)["pipelines"][0]["stages"]["seg"]["source"])

    assert source(text) == "snapdragon-888, dsp in fp16"
    assert source(text, "--precision", "w8a8") == "snapdragon-888, dsp in int8"
    own = text.replace('in = "frame"', 'in = "frame", precision = "int8"')
    assert source(own, "--precision", "float") == "snapdragon-888, dsp in int8"


def test_a_precision_that_nobody_says_is_told(documents: Predict, tmp_path: Path) -> None:
    """A graph without weights says none, so the DSP's own counts, and the GPU's in the variant."""
    write_file(tmp_path, DEPTH)
    model = onnx.load(tmp_path / "depth.onnx")
    sizes = list(model.graph.initializer.pop().dims)
    model.graph.input.append(onnx.helper.make_tensor_value_info("weights", onnx.TensorProto.FLOAT, sizes))
    onnx.save(model, tmp_path / "bare.onnx")
    text = """
    [stages]
    a = { unit = "a", time_ms = 1 }
    bare = { onnx = "bare.onnx", unit = "dsp", in = "a" }
    full = { onnx = "depth.onnx", unit = "dsp", in = "a" }
    """
    chip = ("--profile", "snapdragon-8-gen-3")
    notes = documents(text, *chip, "--set", "stages.bare.unit=gpu")["notes"]
    (said,) = [note for note in notes if note.startswith("networks whose file says no precision")]
    assert ": bare int8, bare fp16; `precision`" in said
    own = text.replace('"bare.onnx"', '"bare.onnx", precision = "fp16"')
    for notes in (documents(text, *chip, "--precision", "w8a8")["notes"], documents(own, *chip)["notes"]):
        assert len(notes) == 1  # that networks are priced alone


def test_the_picture_of_an_own_pipeline_has_nothing_to_compare_with(predict: Predict) -> None:
    """As `trilane run` says of it."""
    lines = dict(predict(DEPTH)["verdict"]["lines"])
    assert lines["IMAGE"] == "nothing to compare with: a pipeline of your own has no true picture"


def test_each_set_is_a_row(documents: Predict) -> None:
    rows = documents(
        DEPTH,
        *("--set", "stages.seg.unit=b"),
        *("--set", "run.fps=20,stages.depth.time_ms={ mean = 15, sd = 0 },stages.seg.time_ms=1"),
    )["pipelines"]
    assert [row["what_if"].partition("=")[0] for row in rows] == ["", "stages.seg.unit", "run.fps"]
    assert [row["period_ms"] for row in rows] == [14, 24, 50]
    assert [row["latency_ms"]["p50"] for row in rows[2:]] == [2 + 15 + 3]
    assert rows[2]["needs_ms"]["mean"] == 15


def test_a_row_says_what_is_unknown_of_a_single_frame(command: Command, tmp_path: Path) -> None:
    lines = command("predict", write_file(tmp_path, DEPTH), "--frames", "1", "--set", "stages.seg.unit=b")[
        0
    ].splitlines()
    (row,) = (line for line in lines if line.startswith("│ the file"))
    assert [cell.strip() for cell in row.split("│")[2:5]] == ["unknown", "unknown", "19"]


@pytest.mark.parametrize(("ms", "said"), [(9999.4, "9999"), (9999.5, "10000"), (12345.6, "12346"), (0.12345, "0.1235")])
def test_times_have_no_exponent(ms: float, said: str) -> None:
    assert _digits(ms) == said


def test_newest_inputs_say_their_age(predict: Predict) -> None:
    """The fast stage begins frame n at 20 n + 1; the slow one has frame 2 m at 40 m + 30.

    So frame 2 j meets frame 2 j - 2, 41 ms old, and frame 2 j + 1 the same, 61 ms old.
    """
    text = """
    [run]
    fps = 50
    latency_to = "fast"
    [stages]
    source = { unit = "s", time_ms = 1 }
    slow = { unit = "a", in = "source", time_ms = 29, every = 2 }
    fast = { unit = "b", in = { now = "source", then = { from = "slow", sync = "latest" } }, time_ms = 2 }
    """
    row = predict(text)["streams"]["slow"]
    assert (row["age_ms"]["mean"], row["age_ms"]["max"]) == (51, 61)
    assert row["frames_behind"] == {"mean": 2.5, "max": 3}


def test_a_what_if_for_an_unknown_stage_names_the_file_s_stages(command: Command, tmp_path: Path) -> None:
    path = write_file(tmp_path, chain("1", "2"))
    error = " ".join(command("predict", path, "--set", "stages.s9.unit=gpu", code=2)[1].split())
    assert "--set: found the unknown stage 's9', expected a stage of the file: " in error


def test_the_answer_says_when_every_leaves_frames_out(predict: Predict) -> None:
    text = """
    [run]
    fps = 25
    [stages]
    a = { unit = "u", time_ms = 2 }
    b = { unit = "v", in = "a", time_ms = 50, every = 2 }
    c = { unit = "w", in = { x = "a", y = "b" }, time_ms = 2 }
    """
    assert predict(text)["rate"]["sentence"].endswith("c has one frame of 2, by every")


def test_a_rate_that_jitter_breaks_is_not_held(predict: Predict) -> None:
    """Samples of 5 and 19 ms have a mean of 12: at 80 frames a second it fits, but each run of 19 ms lasts too long.

    The same mean without jitter drops none.
    """
    head = '[run]\nfps = 80\npolicy = "latest"'
    jitter, steady = (predict(chain(times, head=head)) for times in ("{ samples = [5, 19] }", "12"))
    dropped = sum(jitter["frames"]["dropped"].values())
    assert dropped > 10
    assert jitter["rate"]["sentence"].startswith("holds 80 fps: not for every frame; ")
    late = jitter["deadline_misses"]
    assert jitter["rate"]["sentence"].endswith(f"; of 1000 frames {dropped} dropped and {late} late")
    assert not jitter["verdict"]["pass"]
    assert f"{dropped} dropped" in dict(jitter["verdict"]["lines"])["FAIL"]
    assert steady["rate"]["sentence"] == "holds 80 fps: yes; 12 ms of 12.5 ms"
    assert steady["verdict"]["pass"]


def test_a_stage_without_a_time_is_refused_by_name(command: Command, tmp_path: Path) -> None:
    error = " ".join(command("predict", write_file(tmp_path, STREET), code=2)[1].split())
    others = ["small", "crop", "overlay", "video"]
    assert f"stages.camera: found video without a time (others without one: {', '.join(others)}), expected" in error
    keys = ",".join(f"stages.{name}.time_ms=MS" for name in ("camera", *others))
    assert f"add time_ms = MS to each, or all in one --set {keys}; " in error
    assert 'time_ms = { from = "FILE" } takes what `trilane times` reads' in error
    assert "--measured RUN and scale = { snapdragon-888 = ... } in each" in error
    error = " ".join(command("predict", write_file(tmp_path, BRANCHES), code=2)[1].split())
    assert "stages.frame: found video without a time (others without one: composite), expected" in error
    options = (tmp_path / "pipeline.toml", "--profile", "host")
    out, error = command("predict", *options, code=2)
    assert "measuring" not in out + error and "scale" not in error
    text = STREET.replace("block =", "time_ms = 2, block =")
    error = " ".join(command("predict", write_file(tmp_path, text), code=2)[1].split())
    assert "stages.crop: found python without a time" in error


def test_a_set_may_say_the_times_that_the_file_lacks(command: Command, documents: Predict, tmp_path: Path) -> None:
    """The file itself then has no row; a --set that leaves a stage without a time is named in the refusal."""
    text = '[stages]\na = { python = "m:f", unit = "a" }\nb = { python = "m:f", unit = "b", in = "a" }'
    both = "stages.a.time_ms=4,stages.b.time_ms=6"
    found = documents(text, "--set", both)
    assert [(each["what_if"], each["period_ms"]) for each in found["pipelines"]] == [(both, 6)]
    assert "the file as it is has no prediction, because only --set says the times of: a, b" in found["notes"]
    file = tmp_path / "pipeline.toml"
    shown = command("predict", file, "--set", both)[0]
    assert f"with {both}" in shown.splitlines()
    two = documents(text, "--set", both, "--set", both.replace("6", "9"))["pipelines"]
    assert [each["period_ms"] for each in two] == [6, 9]
    error = " ".join(command("predict", file, "--set", both, "--set", "stages.b.time_ms=9", code=2)[1].split())
    assert "pipeline.toml: stages.a, with --set stages.b.time_ms=9: found python without a time, expected" in error
    assert "all in one --set stages.a.time_ms=MS; " in error


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (("--fps", "30"), "--fps beside a pipeline file"),
        (("--frames", "0"), "--frames"),
        (("--set", "stages.depth.unti=a"), "did you mean 'unit'?"),
        (("--set", "depth"), "KEY=VALUE"),
    ],
)
def test_options_that_mean_nothing_beside_a_file(
    command: Command, tmp_path: Path, options: tuple[str, ...], said: str
) -> None:
    assert said in " ".join(command("predict", write_file(tmp_path, DEPTH), *options, code=2)[1].split())


def test_options_of_a_file_without_one(command: Command) -> None:
    assert "--seed without a pipeline file" in command("predict", "--seed", "3", code=2)[1]


@pytest.mark.parametrize(
    ("times", "words"),
    [
        ((15, 12, 19), "holds 30 fps: yes; 12-19 ms of 33.3 ms (80 %)"),
        ((30, 22, 40), "holds 30 fps: perhaps; 22-40 ms of 33.3 ms (80 %)"),
        ((50, 40, 60), "holds 30 fps: no; 40-60 ms of 33.3 ms (80 %)"),
        ((14, 14, 14), "holds 30 fps: yes; 14 ms of 33.3 ms"),
        ((5000, 1234.5, 9000), "holds 30 fps: no; 1234-9000 ms of 33.3 ms (80 %)"),
        ((15,), "holds 30 fps: yes; 15 ms of 33.3 ms (no interval)"),
    ],
)
def test_the_sentence(times: tuple[float, ...], words: str) -> None:
    assert holding(30, FrameInterval(*times)).sentence == words


@pytest.mark.parametrize("precision", [None, "float", "w8a8"])
@pytest.mark.parametrize("chip", ["snapdragon-888", "snapdragon-8-gen-3", "agx-orin"])
def test_a_network_has_one_price_by_itself_as_a_file_and_on_a_chip_that_it_could_share(
    command: Command, tmp_path: Path, chip: str, precision: str | None
) -> None:
    """A network of floats: its time, its interval and its frames at a rate that holds and at one that does not."""
    path = tmp_path / "net.onnx"
    onnx.save(network(512, "y", 64), path)
    asked = ["--profile", chip, "--performance-profile", "burst", "--json"]
    asked += ["--precision", precision] if precision else []
    (bare,) = json.loads(command("predict", "--network", path, *asked)[0])["networks"]
    expected = {"fp16": "fp16", None: bare["precision"], "w8a8": "int8", "float": "fp16"}[precision]
    assert bare["numbers"] == "float" and bare["precision"] == expected
    ms, around = bare["network_ms"], [bare["low_ms"], bare["high_ms"]]
    for fps in (500 / ms, min(2000 / ms, 1000)):
        rate = f"{fps:.9f}"
        file = write_file(
            tmp_path,
            f'[run]\nfps = {rate}\npolicy = "latest"\n[stages]\n'
            'src = { unit = "other", time_ms = 0 }\nnet = { onnx = "net.onnx", unit = "dsp", in = "src" }',
        )
        of_file = json.loads(command("predict", file, *asked)[0])["pipelines"][0]
        beside = json.loads(command("predict", f"{path}@{rate}", *asked)[0])["pipelines"][0]
        assert beside["precision"] == bare["precision"]
        assert of_file["stages"]["net"]["source"].endswith(f"in {bare['precision']}")
        for answer, stage in ((of_file, "net"), (beside, "infer")):
            assert answer["stages"][stage]["service_ms"]["mean"] == pytest.approx(ms, abs=2e-6)
            assert answer["stages"][stage]["alone_ms"] == pytest.approx(ms, abs=2e-6)
            assert list(answer["needs_ms"].values()) == pytest.approx([ms, *around], rel=2e-3)
            assert answer["needs_ms"]["mean"] == pytest.approx(ms, abs=2e-6)
            assert answer["rate"]["holds"] is (ms <= 1e3 / fps)
            assert answer["frame_time_ms"]["mean"] == pytest.approx(max(ms, 1e3 / fps), rel=1e-3)


def test_the_text(command: Command, tmp_path: Path, check_printed: Callable[[str, str], None]) -> None:
    text = STREET.replace("block =", "time_ms = 3, block =").replace("python =", "time_ms = 2, python =")
    what_ifs = ("--set", "stages.segmenter.unit=gpu", "--set", "run.fps=120")
    check_printed("predict-file", command("predict", write_file(tmp_path, text), *what_ifs)[0])


def test_measured_times_are_those_of_a_run_and_on_a_chip_times_their_scale(
    command: Command, documents: Predict, tmp_path: Path
) -> None:
    """A run in virtual time stands for one here: depth takes 20 and 10 in turn, so 15 in the mean."""
    text = """
    [stages]
    frame = { block = "busy", unit = "a", load_ms = 2 }
    depth = { python = "m:f", unit = "b", in = "frame", scale = { snapdragon-888 = 2 } }
    end   = { block = "discard", unit = "a", in = "depth" }
    """
    file = read_pipeline(write_file(tmp_path, text))

    def service(stage: str, _unit: str, frame: int, _begin_ns: int) -> int:
        return {"frame": 3, "depth": 20 - 10 * (frame % 2), "end": 1}[stage] * 1_000_000

    done = simulate(graph_of(file, edge_rules(file)), Settings(40), service, keep=True)
    run = write_run(tmp_path / "run", done)
    rows = documents(text, "--measured", str(run))["pipelines"][0]["stages"]
    here = rows["depth"]
    assert rows["frame"]["alone_ms"] == 3  # not 2, which the file only asks for
    assert (here["alone_ms"], here["service_ms"]["max"]) == (15, 20)
    assert here["low_ms"] < 15 < here["high_ms"]
    on_chip = documents(text, "--measured", str(run), "--profile", "snapdragon-888")["pipelines"][0]["stages"]
    chip, busy, end = (on_chip[name] for name in ("depth", "frame", "end"))
    assert (chip["alone_ms"], chip["source"]) == (30, f"measured in {run}, times 2")
    assert (busy["alone_ms"], busy["source"]) == (2, "block busy")
    assert (end["alone_ms"], end["source"]) == (0, "block discard")
    options = ("--measured", run, "--profile", "snapdragon-8-gen-3")
    error = " ".join(command("predict", tmp_path / "pipeline.toml", *options, code=2)[1].split())
    assert "stages.depth: found python without a time" in error
    assert "scale = { snapdragon-8-gen-3 = ... }" in error
    command("predict", tmp_path / "pipeline.toml", "--measured", tmp_path / "none", code=2)


def test_a_scale_that_makes_a_time_too_long_is_refused(tmp_path: Path) -> None:
    file = read_pipeline(
        write_file(tmp_path, '[stages]\na = { python = "m:f", unit = "b", scale = { snapdragon-888 = 2 } }')
    )
    measured = MeasuredStages({"a": StageTime(mean=3e6)}, "run", "snapdragon-888")
    said = r"stages.a.scale.snapdragon-888: found a factor of 2 for times around 3e\+06 ms, expected no time above"
    with pytest.raises(BadInputError, match=said):
        measured_price(file, "a", measured)


def test_here_a_job_takes_its_unit_from_the_moment_it_is_handed_over(documents: Predict, tmp_path: Path) -> None:
    """Of 8 ms that a job of `a` holds its unit, it waits 2 for a core; a chip's unit waits for none.

    The unit is handed the next job 1 ms before it is done with the last: that millisecond is the last one's.
    """
    text = """
    [stages]
    a = { block = "busy", unit = "a", load_ms = 1, scale = { snapdragon-888 = 10 } }
    b = { block = "busy", unit = "b", load_ms = 1, in = "a" }
    """
    file = read_pipeline(write_file(tmp_path, text))
    done = simulate(graph_of(file, edge_rules(file)), Settings(40), lambda *_: 8_000_000, keep=True)
    waited = [job._replace(begin_ns=job.begin_ns + 2_000_000) for job in done.jobs]
    early = [job._replace(dispatch_ns=job.dispatch_ns - 1_000_000 * (job.frame > 1)) for job in waited]
    run = str(write_run(tmp_path / "run", done, early))
    here = documents(text, "--measured", run)["pipelines"][0]
    assert (here["stages"]["a"]["alone_ms"], here["stages"]["b"]["alone_ms"]) == (8, pytest.approx(8, abs=0.1))
    assert here["frame_time_ms"]["mean"] == pytest.approx(8, rel=0.01)
    on_chip = documents(
        text.replace("load_ms = 1, in", "load_ms = 1, scale = { snapdragon-888 = 1 }, in"),
        "--measured",
        run,
        "--profile",
        "snapdragon-888",
    )
    assert on_chip["pipelines"][0]["stages"]["a"]["alone_ms"] == 60


def test_a_chip_loses_no_time_to_other_programs_of_this_machine(documents: Predict, tmp_path: Path) -> None:
    """Of the 8 ms of each job, its unit had no core for 3; a journal that says more than the job had leaves nothing."""
    text = """
    [stages]
    a = { block = "busy", unit = "a", load_ms = 1, scale = { snapdragon-888 = 10 } }
    b = { block = "busy", unit = "b", load_ms = 1, scale = { snapdragon-888 = 10 }, in = "a" }
    """
    file = read_pipeline(write_file(tmp_path, text))
    done = simulate(graph_of(file, edge_rules(file)), Settings(40), lambda *_: 8_000_000, keep=True)
    lost = [job._replace(preempted_ns={"a": 3_000_000, "b": 9_000_000}[job.stage]) for job in done.jobs]
    run = str(write_run(tmp_path / "run", done, lost))
    here, on_chip = (documents(text, "--measured", run, "--profile", chip) for chip in ("host", "snapdragon-888"))
    alone = [found["pipelines"][0]["stages"]["a"]["alone_ms"] for found in (here, on_chip)]
    assert alone == [8, 50]
    assert on_chip["pipelines"][0]["stages"]["b"]["alone_ms"] == 0
    clocks = [[note for note in found["notes"] if note.startswith("measured")] for found in (here, on_chip)]
    assert clocks == [
        ["measured times count from the hand-over of a job, with its waits for a core"],
        ["measured times leave out the waits for a core that this machine's kernel counted"],
    ]


@pytest.mark.parametrize(
    ("others", "said"),
    [
        (0.27, "UNSURE: its times are from an UNSURE run: other programs took 27 % of its cores; computed"),
        (None, "UNSURE: its times are from an UNSURE run: nobody knows what other programs took of its cores; "),
        (0.01, "computed, and the whole 80 % interval is on one side of the target"),
    ],
)
def test_a_prediction_is_trusted_no_more_than_the_run_whose_times_it_takes(
    documents: Predict, tmp_path: Path, others: float | None, said: str
) -> None:
    """`None`: the run was ended before it wrote a report. A file that states all times takes none of the run."""
    text = '[stages]\na = { python = "m:f", unit = "a" }'
    file = read_pipeline(write_file(tmp_path, text))
    done = simulate(graph_of(file, edge_rules(file)), Settings(40), lambda *_: 8_000_000, keep=True)
    run = write_run(tmp_path / "run", done)
    (run / "report.json").unlink()
    if others is not None:
        (run / "report.json").write_text(json.dumps(make_report(other_programs=others)), encoding="utf-8")
    verdict = documents(text, "--measured", str(run))["pipelines"][0]["verdict"]
    assert dict(verdict["lines"])["TRUST"].startswith(said)
    assert verdict["trusted"] is (others == 0.01)
    own = documents(text.replace("m:f", 'm:f", time_ms = 5, unit = "a" }#'), "--measured", str(run))["pipelines"][0]
    assert dict(own["verdict"]["lines"])["TRUST"] == "computed; the times have no interval"


@pytest.mark.parametrize(
    ("shown_ms", "stop_ms", "repeats", "expected_ms"),
    [
        ({0: 5, 1: 6, 2: 8, 3: 10, 4: 12, 5: 100}, 12, 1, 2),  # neither the start nor what comes after the stop
        ({0: 0, 3: 9, 6: 18, 9: 30}, 30, 3, 4),  # one frame of three is shown; the half has 3 of 9 frames
        ({n: 4 * (n // 2) + n % 2 for n in range(123)}, 999, 1, 2),  # 1 and 3 in turn: 60 frames count, not 61
        ({0: 5}, 40, 1, 40),
        ({}, 40, 1, 40),
    ],
)
def test_the_second_half_of_a_run_by_hand(
    shown_ms: dict[int, int], stop_ms: int, repeats: int, expected_ms: float
) -> None:
    run: Any = SimpleNamespace(shown_ns={frame: 1_000_000 * ms for frame, ms in shown_ms.items()})
    assert steady_ms(run, 1_000_000 * stop_ms, repeats) == expected_ms


#: The pipeline of tests/core/scheduler/test_bypass_by_hand.py, of whose five frames 2 and 3 skip `net`.
ROUND = """
[stages]
pose = {{ unit = "cpu", time_ms = 3, bypass = {{ to = "show", {} }} }}
net = {{ unit = "dsp", in = "pose", time_ms = 7 }}
show = {{ unit = "gpu", in = "net", time_ms = 1 }}
"""


def test_frames_that_skip_a_stage_are_where_they_were_worked_out(predict: Predict) -> None:
    """Presented at 11, 18, 19, 21, 31; latencies 11, 15, 9, 4, 11. Of five frames the DSP works three times 7 ms."""
    answer = predict("[run]\nframes = 5" + ROUND.format('pattern = "00110"'))
    assert (answer["frame_time_ms"]["mean"], answer["frame_time_ms"]["max"]) == (5, 10)
    assert (answer["latency_ms"]["mean"], answer["latency_ms"]["max"]) == (10, 15)
    assert (answer["frames"]["presented"], answer["frames"]["skipped"]) == (5, 2)
    assert {name: row["jobs"] for name, row in answer["stages"].items()} == {"pose": 5, "net": 3, "show": 5}
    assert (answer["period_ms"], answer["limit"], answer["cycle"]) == (4.2, "unit dsp", ["net"])


def test_what_a_frame_needs_is_a_mean_of_both_ways(predict: Predict) -> None:
    """One frame at a time: 3 + 7 + 1 = 11 ms, or 3 + 1 = 4 ms; a unit alone works at most 3.5 ms a frame."""
    head = '[run]\npolicy = "sequential"\n'
    answer = predict(head + "fps = 100" + ROUND.format('pattern = "01"'))
    assert (answer["needs_ms"]["mean"], answer["period_ms"]) == (7.5, 10)
    assert answer["rate"]["sentence"].startswith("holds 100 fps: ")
    assert predict(head + ROUND.format('pattern = "01"'))["period_ms"] == 3.5
    some = predict(head + "frames = 4000" + ROUND.format("share = 0.25"))
    assert some["frame_time_ms"]["mean"] == pytest.approx(11 - 7 * 0.25, abs=3 * 7 * sqrt(0.25 * 0.75 / 4000))
    none, whole = (predict(head + ROUND.format(f"share = {share}")) for share in (0, 1))
    assert (none["frame_time_ms"]["mean"], whole["frame_time_ms"]["mean"]) == (11, 4)
    assert (none["frames"]["skipped"], whole["frames"]["skipped"]) == (0, 1000)


def test_another_share_is_a_what_if_and_a_seed_other_frames(documents: Predict) -> None:
    text = ROUND.format("share = 0.5")
    rows = documents(text, "--set", "stages.pose.bypass.share=0.9")["pipelines"]
    skipped = [row["frames"]["skipped"] for row in rows]
    assert skipped == pytest.approx([500, 900], abs=50)
    assert documents(text, "--seed", "1")["pipelines"][0]["frames"]["skipped"] != skipped[0]


@pytest.mark.parametrize("edge", ["single", "double", "orphan"])
@pytest.mark.parametrize(("policy", "fps"), [("pipelined", None), ("sequential", None), ("latest", 20.0)])
def test_the_application_runs_as_a_file_of_its_stages(policy: str, fps: float | None, edge: str) -> None:
    """Two ways to the same run: every figure is the same, to the last digit. A latency at a rate has another begin."""
    chip = load_runnable("snapdragon-888")
    network = reference_network(NetworkSpec("resnet18", "batch", 768, 768, 16, "packed"))
    plan, corners = Plan(network, "dsp", Variant(policy, edge, fps=fps or 30.0)), corners_of(chip, SUSTAINED)
    report = simulated(chip, plan, corners).report
    stages: dict[str, dict[str, Any]] = {}
    for (name, unit), ms in stage_times_ms(chip, plan, corners).items():
        stages[name] = {"unit": unit, "time_ms": ms, **({"in": list(stages)[-1]} if stages else {})}
    run = {"policy": policy, "edge": edge, "latency_to": "composite", **({"fps": fps} if fps else {})}
    file = checked_tables({"run": run, "stages": stages}, Path("application.toml"))
    own = predict_file(file, prices_of(file, {}, lambda *_: chip, lambda _: corners), report["frames"]["requested"])
    assert report["frame_time_ms"]["mean"] > 20, "else the display would hold the application"
    assert own["frame_time_ms"] == report["frame_time_ms"] | {key: own["frame_time_ms"][key] for key in ("low", "high")}
    for key in ("frames", "fps", "deadline_misses", "units"):
        assert own[key] == report[key], key
    for name, row in report["stages"].items():
        assert {key: own["stages"][name][key] for key in row} == row
    if fps is None:
        assert own["latency_ms"]["mean"] == report["latency_ms"]["mean"]


def test_a_run_gives_the_share_of_its_frames_that_skipped(documents: Predict, tmp_path: Path) -> None:
    """30 of 40 frames went past `net`, of whose ten each took 7 ms; a share in the file would go before."""
    text = ROUND.format("").replace('{ to = "show",  }', '"show"')
    file = read_pipeline(write_file(tmp_path, text))
    times = {"pose": 3_000_000, "net": 7_000_000, "show": 1_000_000}
    done = simulate(
        graph_of(file, edge_rules(file)),
        Settings(40),
        lambda stage, *_: times[stage],
        skips=lambda frame, _fresh: frame % 4 > 0,
        keep=True,
    )
    run = write_run(tmp_path / "run", done)
    found = documents(text, "--measured", str(run))
    assert found["pipelines"][0]["frames"]["skipped"] == pytest.approx(750, abs=3 * sqrt(1000 * 0.75 * 0.25))
    assert len(found["notes"]) == 1  # which clock it is, not that nobody knows the share
    said = documents(ROUND.format("share = 0"), "--measured", str(run))["pipelines"][0]
    assert said["frames"]["skipped"] == 0
