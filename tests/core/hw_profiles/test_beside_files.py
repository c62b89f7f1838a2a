"""Pipeline files that share a chip: alone as by themselves, in turns by hand, and their networks as bare ones."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import onnx
import pytest

from support.pipeline_files import DEPTH, additions
from trilane.apps.predict import asked_pipelines as sources
from trilane.apps.predict.predicted_verdict import pipeline_verdict
from trilane.errors import BadInputError
from trilane.hw_profiles.application import Plan, stage_times_ms
from trilane.hw_profiles.pipeline_prediction import predict_file, prices_of
from trilane.hw_profiles.profile_files import load_profile
from trilane.hw_profiles.reference_networks import NetworkSpec, reference_network
from trilane.hw_profiles.schema import corners_of
from trilane.hw_profiles.shared_chip import needed, predict_beside, together
from trilane.hw_profiles.tenants import FileTenant, SharingPipeline, Tenant
from trilane.units import SUSTAINED

CHIP = load_profile("snapdragon-888")
CORNERS = corners_of(CHIP, SUSTAINED)
OWN = CHIP.memory.application_use_fraction.or_else(0.0)

#: One stage of 6 ms on the GPU, and one of 4 ms that has the name of its own for it.
SIX = '[run]\nfps = 50\n[stages]\na = { unit = "gpu", time_ms = 6 }'
FOUR = '[run]\nfps = 50\n[units]\nmine = { hardware = "gpu" }\n[stages]\na = { unit = "mine", time_ms = 4 }'
#: A join, a stage that takes every third frame, and times that differ from frame to frame.
MIXED = """
[run]
fps = 40
policy = "latest"
[stages]
camera = { unit = "isp", time_ms = { mean = 4, sd = 2 } }
left = { unit = "npu", in = "camera", time_ms = { exponential = 9 } }
right = { unit = "cpu", in = "camera", time_ms = 3 }
shown = { unit = "gpu", in = { a = "left", b = "right" }, every = 3, time_ms = 5 }
"""
#: Every third frame skips a stage.
SKIPPING = """
[run]
fps = 50
[stages]
a = { unit = "cpu", time_ms = 3, bypass = { to = "c", pattern = "001" } }
b = { unit = "npu", in = "a", time_ms = 9 }
c = { unit = "gpu", in = "b", time_ms = 2 }
"""
#: Two networks at once, each fed by a camera of no time.
NETWORKS = """
[run]
fps = 0.5
[stages]
camera = { unit = "isp", time_ms = 0 }
one = { onnx = "add.onnx", unit = "gpu", in = "camera" }
other = { onnx = "add.onnx", unit = "dsp", in = "camera" }
"""
#: Two networks in a row, which take turns on one unit: their slots give them a b a b, or a a b b.
ROW = """
[run]
fps = 1
[stages]
camera = { unit = "isp", time_ms = 0 }
one = { onnx = "add.onnx", unit = "dsp", in = "camera" }
other = { onnx = "add.onnx", unit = "dsp", in = "one" }
"""
ONE = '[run]\nfps = 0.5\n[stages]\ncamera = { unit = "isp", time_ms = 0 }\n'
ONE += 'net = { onnx = "add.onnx", unit = "gpu", in = "camera" }\n'

Asked = Callable[..., list[SharingPipeline]]
Command = Callable[..., tuple[str, str]]


@pytest.fixture
def asked(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Asked:
    """Pipelines as typed, where a text with a line break is the content of a pipeline file; `add.onnx` is there."""
    monkeypatch.chdir(tmp_path)
    onnx.save(additions(512), "add.onnx")

    def read(*texts: str, precision: str | None = None) -> list[SharingPipeline]:
        for number, text in enumerate(texts):
            Path(f"file{number}.toml").write_text(text, encoding="utf-8")
        named = [f"file{number}.toml" if "\n" in text else text for number, text in enumerate(texts)]
        return sources.tenants(named, precision=precision)

    return read


def avatar() -> Tenant:
    network = reference_network(NetworkSpec("mobilenetv2", "batch", 256, 256, 16, "packed"))
    return Tenant("avatar", "", (network,), (0,), 30.0)


def reports(tenants: Sequence[SharingPipeline]) -> list[dict[str, Any]]:
    return [run.report for run in together(CHIP, tenants, CORNERS).runs]


@pytest.mark.parametrize(
    "text",
    ["[run]\nfps = 50" + DEPTH, SIX, FOUR, MIXED, SKIPPING],
    ids=["join", "one", "own unit", "mixed", "bypass"],
)
def test_a_file_alone_on_a_chip_is_the_file_by_itself(asked: Asked, text: str) -> None:
    """Its simulated run has the same frames and the same luck, so every figure of the run is the same."""
    (one,) = asked(text)
    assert isinstance(one, FileTenant)
    found = predict_beside(CHIP, [one])["pipelines"][0]
    own = predict_file(one.file, prices_of(one.file, {}, lambda *_: CHIP, lambda _: CORNERS), round(10 * one.fps))
    assert found["kind"] == "pipeline" and found["precision"] is None
    assert found["fps"] == pytest.approx(own["fps"])
    assert found["frames"]["dropped"] == own["frames"]["dropped"]
    for key in ("frame_time_ms", "latency_ms"):
        assert found[key]["mean"] == pytest.approx(own[key]["mean"]), key
    assert found["latency_ms"] == found["response_ms"]
    for unit, row in own["units"].items():
        assert found["units"][unit]["busy"] == pytest.approx(row["busy"], rel=2e-3), unit  # it ends at a period
    assert found["needs_ms"] == pytest.approx(own["needs_ms"], rel=1e-9)
    assert found["rate"]["sentence"].partition(";")[0] == own["rate"]["sentence"].partition(";")[0]


def test_frames_that_every_leaves_out_are_not_missed(asked: Asked) -> None:
    """The stage of 15 ms takes one frame of three, so a frame needs 5 ms of the 10 that it has."""
    text = '[run]\nfps = 100\n[stages]\na = { unit = "cpu", time_ms = 4 }\n'
    (row,) = predict_beside(CHIP, asked(text + 'b = { unit = "npu", time_ms = 15, in = "a", every = 3 }'))["pipelines"]
    assert (row["in_time"], row["deadline_misses"]) == (1, 0)
    assert row["needs_ms"]["mean"] == pytest.approx(5, rel=1e-9)
    assert row["rate"]["sentence"].startswith("holds 100 fps: yes; 5 ms of 10 ms")


def test_two_files_take_turns_on_the_unit_that_both_mean(asked: Asked) -> None:
    """Both are released at once: 6 ms, then the 4 ms of the other one, 30 % of whose time is waiting."""
    two = asked(SIX, FOUR)
    one, other = predict_beside(CHIP, two)["pipelines"]
    assert [row["response_ms"]["mean"] for row in (one, other)] == [6, 10]
    assert [row["alone"]["response_ms"]["mean"] for row in (one, other)] == [6, 4]
    (gpu,), (mine,) = one["units"].values(), other["units"].values()
    assert (gpu["hardware"], mine["hardware"]) == ("gpu", "gpu")
    assert (gpu["busy"], mine["busy"]) == pytest.approx((0.3, 0.2))
    assert mine["idle"]["preempted"] == pytest.approx(0.3)
    # The first one, always fed, has the GPU but for 4 ms of every 20.
    assert needed(CHIP, two, 0, CORNERS, "round-robin").ms == pytest.approx(6 / 0.8, rel=0.01)


@pytest.mark.parametrize(
    ("stems", "names"),
    [
        (["a", "b"], ["a", "b"]),
        (["a", "b", "a"], ["a (1)", "b", "a (2)"]),
        (["a", "a", "a (1)"], ["a (2)", "a (3)", "a (1)"]),
        (["a", "a", "a (1)", "a (1)"], ["a (2)", "a (3)", "a (1) (1)", "a (1) (2)"]),
    ],
)
def test_no_two_pipelines_have_one_name(stems: list[str], names: list[str]) -> None:
    assert sources._names(stems) == names


def test_a_file_beside_a_scene_has_the_gpu_before_it(asked: Asked) -> None:
    """The file has the GPU from the release on, for 6 ms. The avatar's raster waits for it from the end of pose on."""
    one = avatar()
    pose_ms = stage_times_ms(CHIP, Plan(one.networks[0], "dsp", one.variant), CORNERS)["pose", "cpu"]
    assert pose_ms < 3
    alone, beside = reports([one])[0], reports([*asked(SIX.replace("fps = 50", "fps = 30")), one])
    expected = alone["response_ms"]["mean"] + 6 - pose_ms
    assert beside[1]["response_ms"]["mean"] == pytest.approx(expected, rel=1e-5)
    assert beside[0]["response_ms"]["mean"] == pytest.approx(6, abs=1e-6)


def test_networks_of_a_file_slow_each_other_as_bare_networks_do(asked: Asked) -> None:
    """Both at once in one file, in a file and by itself, and both by themselves: the same times, longer than alone."""
    bare = [each["response_ms"]["mean"] for each in reports(asked("add.onnx@0.5:gpu", "add.onnx@0.5"))]
    (file,) = reports(asked(NETWORKS))
    assert [file["stages"][name]["service_ms"]["mean"] for name in ("one", "other")] == pytest.approx(bare, rel=1e-5)
    mixed = reports(asked(ONE, "add.onnx@0.5"))
    assert [each["response_ms"]["mean"] for each in mixed] == pytest.approx(bare, rel=1e-5)
    alone = [reports(asked(text))[0]["response_ms"]["mean"] for text in ("add.onnx@0.5:gpu", "add.onnx@0.5")]
    assert all(slow > 1.03 * ms for slow, ms in zip(bare, alone, strict=True))


def test_the_network_of_a_file_has_the_price_and_the_interval_of_a_bare_one(asked: Asked) -> None:
    """Also beside an avatar, which takes its share of the memory all the time, and in another precision."""
    for precision in (None, "int8"):
        texts = (ONE.replace('"gpu"', '"dsp"'), "add.onnx@0.5")
        file, bare = (asked(text, precision=precision)[0] for text in texts)
        both = [together(CHIP, [each, avatar()], CORNERS).stages_ms[0] for each in (file, bare)]
        assert both[0]["net"] == pytest.approx(both[1]["infer"])
        needs = [needed(CHIP, [each], 0, CORNERS, "round-robin") for each in (file, bare)]
        assert needs[0] == pytest.approx(needs[1], rel=1e-4)
        assert needs[0].low_ms < needs[0].ms < needs[0].high_ms
    stated = ONE.replace('"gpu"', '"dsp", precision = "fp16"')
    assert together(CHIP, asked(stated, precision="int8"), CORNERS).stages_ms[0]["net"] > 1.2 * both[0]["net"]


def test_two_networks_in_a_row_need_the_same_as_a_file_and_on_a_chip_that_they_could_share(asked: Asked) -> None:
    """That is twice as much as one, also at both ends of the interval: their errors are one."""
    row, bare = asked(ROW, "add.onnx@0.5")
    assert isinstance(row, FileTenant)
    prices = prices_of(row.file, row.graphs, lambda name, _, unit: row.chip(name, CHIP, unit), lambda _: CORNERS)
    answer = predict_file(row.file, prices)
    alone, one = (needed(CHIP, [each], 0, CORNERS, "round-robin") for each in (row, bare))
    assert list(answer["needs_ms"].values()) == pytest.approx(alone, abs=1e-9)
    assert alone == pytest.approx([2 * ms for ms in one], abs=1e-5)  # whole nanoseconds
    assert alone.low_ms < 0.9 * alone.ms < 1.1 * alone.ms < alone.high_ms
    latency, frame_time = answer["latency_ms"], answer["frame_time_ms"]
    assert latency["low"] < 0.9 * latency["mean"] < 1.1 * latency["mean"] < latency["high"]
    assert (frame_time["low"], frame_time["high"]) == (1000, answer["needs_ms"]["high"])


def test_a_pipeline_that_others_never_let_run_does_not_hold(asked: Asked) -> None:
    """The first one, always fed, has no deadlines, and the other one has frames that are late from the start."""
    two = asked(SIX, FOUR.replace("= 50", "= 300"))
    needs = needed(CHIP, two, 0, CORNERS, "deadline")
    assert needs.ms == needs.low_ms > 1000


def test_a_network_whose_time_the_file_gives_takes_no_memory(asked: Asked) -> None:
    given = ONE.replace('"add.onnx"', '"add.onnx", time_ms = 700')
    (_, bare), (alone,) = reports(asked(given, "add.onnx@0.5")), reports(asked("add.onnx@0.5"))
    assert bare["response_ms"]["mean"] == pytest.approx(alone["response_ms"]["mean"], rel=1e-9)


def test_units_that_are_not_on_the_chip_are_one_where_they_have_one_name(asked: Asked) -> None:
    """Two files with one `npu` take turns on it; the chip's own units stay idle."""
    text = SIX.replace("gpu", "npu")
    answer = predict_beside(CHIP, asked(text, text))
    assert [row["response_ms"]["mean"] for row in answer["pipelines"]] == [6, 12]
    assert [row["units"]["npu"]["hardware"] for row in answer["pipelines"]] == ["npu", "npu"]
    assert all(row["busy"] == 0 for row in answer["units"].values())


@pytest.mark.parametrize(
    "stage",
    ['time_ms = 0, in = "a"', 'time_ms = 2, in = { from = "a", sync = "latest" }'],
    ids=["all", "before latest"],
)
def test_stages_of_no_time_end(asked: Asked, stage: str) -> None:
    text = '[run]\nfps = 100\n[stages]\na = { unit = "cpu", time_ms = 0 }\nb = { unit = "npu", ' + stage + " }"
    (row,) = predict_beside(CHIP, asked(text))["pipelines"]
    assert row["needs_ms"]["mean"] == pytest.approx(0 if "= 0," in stage else 2, abs=1e-3)
    assert row["rate"]["holds"]


def test_a_rate_as_typed_replaces_that_of_the_file(asked: Asked) -> None:
    asked(SIX)
    (changed,) = sources.tenants(["file0.toml@24"])
    Path("file0.toml").write_text(SIX.replace("fps = 50", "arrivals = { poisson = 20 }"), encoding="utf-8")
    (paced,) = sources.tenants(["file0.toml@20"])
    assert (changed.fps, changed.source, changed.name, paced.fps) == (24, "file0.toml@24", "file0", 20)


BAD = {
    "no rate": (SIX.replace("fps = 50", ""), "", "file0.toml: run.fps: found no rate"),
    "random arrivals": (SIX.replace("fps = 50", "arrivals = { poisson = 20 }"), "", "such as file0.toml@30"),
    "a unit behind": (SIX, "@30:gpu", "the unit gpu for a pipeline file, expected its rate alone; leave out :gpu"),
    "a rate of zero": (SIX, "@0", "rate '0', expected frames a second, 0.001 to 1000"),
    "a rate of the file": (SIX.replace("50", "2000"), "", "file0: rate: found 2000"),
    "no time": (
        SIX.replace("time_ms = 6", 'python = "crop:best"')
        + '\nb = { unit = "cpu", block = "encode", path = "x.mp4", in = "a" }',
        "",
        "stages.a: found python without a time (others without one: b), expected a stage whose time is known; "
        'add time_ms = MS to each; time_ms = { from = "FILE" } takes what `trilane times` reads',
    ),
    "a missing network": (ONE.replace("add.", "none."), "", "stages.net.onnx"),
    "ports that do not fit": (
        ONE.replace("time_ms = 0", 'time_ms = 0, out = "f32 3"'),
        "",
        "stages.net.in: found f32 3",
    ),
}


@pytest.mark.parametrize("case", BAD)
@pytest.mark.usefixtures("asked")
def test_bad_input_is_named(case: str) -> None:
    text, behind, said = BAD[case]
    Path("file0.toml").write_text(text, encoding="utf-8")
    with pytest.raises(BadInputError) as error:
        predict_beside(CHIP, sources.tenants([f"file0.toml{behind}"]))
    assert said in str(error.value)
    assert "--measured" not in str(error.value)


def test_a_file_beside_others_as_a_table_and_as_json(
    asked: Asked, command: Command, check_printed: Callable[[str, str], None]
) -> None:
    """The file comes first, or after a network; units with names of their own stand below the chip's."""
    asked(MIXED, FOUR)
    arguments = ("predict", "file0.toml", "--beside", "file1.toml@20", "--beside", "add.onnx@2")
    check_printed("predict-beside-files", command(*arguments)[0])
    answer = json.loads(command(*arguments, "--json")[0])
    assert [(row["name"], row["kind"], row["rate_fps"]) for row in answer["pipelines"]] == [
        ("file0", "pipeline", 40),
        ("file1", "pipeline", 20),
        ("add", "network", 2),
    ]
    for row in answer["pipelines"]:
        verdict = row["verdict"]
        assert verdict == pipeline_verdict(row, is_cold=True).shown()
        assert (verdict["target_fps"], verdict["pass"]) == (row["rate_fps"], row["rate"]["holds"])
        assert verdict["lines"][0][1].startswith(f"{1e3 / row['needs_ms']['mean']:.3g} fps")
    due = answer["pipelines"][0]["frames"]["presented"] + 3  # the others are left out by `every`
    missed = f"at 40 fps {answer['pipelines'][0]['deadline_misses']} of {due} frames late, 3 dropped"
    assert answer["pipelines"][0]["verdict"]["lines"][0][1].endswith(missed)
    assert [row["verdict"]["bound"]["unit"] for row in answer["pipelines"]] == ["npu", "mine", "dsp"]
    images = [dict(row["verdict"]["lines"])["IMAGE"].startswith("nothing to compare") for row in answer["pipelines"]]
    assert images == [True, True, False]
    assert answer["config"]["performance_profile"] == SUSTAINED
    (mine,) = answer["pipelines"][1]["units"].values()
    assert answer["units"]["gpu"]["by_pipeline"]["file1"] == pytest.approx(mine["busy"], rel=0.01)
    assert "--set with --beside" in command(*arguments, "--set", "run.fps=3", code=2)[1]
