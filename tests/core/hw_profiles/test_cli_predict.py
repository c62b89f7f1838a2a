"""`trilane predict` beside doubles of what predicts: what is asked, each refusal, and answers that a test wrote."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from trilane.apps.cli import predict as cli
from trilane.apps.cli import predict_output
from trilane.apps.predict.predict_options import PredictOptions
from trilane.apps.run.predicted_verdict import predicted_verdict
from trilane.avatars.bundle import load_bundle
from trilane.hw_profiles import governor, profile_files, reference_networks
from trilane.hw_profiles import predict as predictions
from trilane.hw_profiles.application import REFERENCE, Plan, Variant
from trilane.hw_profiles.network_work import Network, count_work
from trilane.hw_profiles.prediction import ApplicationPrediction, NetworkPrediction
from trilane.hw_profiles.rates import NOTHING, Wanted
from trilane.hw_profiles.reference_networks import NetworkSpec
from trilane.units import BURST, SUSTAINED

Command = Callable[..., tuple[str, str]]
CHIP = profile_files.load_profile("snapdragon-888").model_copy(update={"name": "chip", "title": "A Chip"})
ANSWER = ApplicationPrediction.model_construct(fps=12.5, notes=())


@pytest.fixture
def asked(monkeypatch: pytest.MonkeyPatch) -> dict[str, Any]:
    """What the command asked of its parts, by their names."""
    found: dict[str, Any] = {}

    def told(name: str, answer: Any) -> Callable[..., Any]:
        return lambda *given, **_: found.update({name: given}) or answer

    monkeypatch.setattr(profile_files, "load_runnable", told("profile", CHIP))
    monkeypatch.setattr(predictions, "predict", lambda *given: found.update(predict=given) or ANSWER)
    monkeypatch.setattr(predictions, "what_if", told("what_if", ["alternatives"]))
    monkeypatch.setattr(cli, "draw", told("draw", None))
    monkeypatch.setattr(cli, "show_answer", told("shown", None))
    monkeypatch.setattr("trilane.hw_profiles.reference_networks.reference_network", lambda spec: spec)
    return found


SPEC: Any = NetworkSpec("mobilenetv2", "group", 96, 64, 4, "split")
DEFAULT = load_bundle("default").read_network()
AS_A_RUN = Variant("pipelined", "double", 1)
USUAL = Plan(Network({"avatar": "default"}, *DEFAULT.shape[1:], "packed", count_work(DEFAULT.model)), "dsp", AS_A_RUN)
PUBLISHED = Plan(NetworkSpec("resnet18", "batch", 512, 512, 16, "packed"), "dsp", REFERENCE)  # type: ignore[arg-type]
OWN = Plan(SPEC, "gpu", Variant("latest", "triple", 3), 0.0)
#: Words of a command -> what is asked of the prediction, and of what else.
ASKED: dict[tuple[str, ...], tuple[tuple[Any, ...], dict[str, Any]]] = {
    (): ((USUAL, SUSTAINED, 0.0, None, NOTHING), {"profile": ("snapdragon-888",)}),
    ("--encoder", "resnet18"): ((PUBLISHED, SUSTAINED, 0.0, None, NOTHING), {}),
    ("--size", "512", "--policy", "pipelined"): (
        (replace(PUBLISHED, variant=AS_A_RUN), SUSTAINED, 0.0, None, NOTHING),
        {},
    ),
    (
        *("--profile", "mine", "--encoder", "mobilenetv2", "--norm", "group", "--size", "96x64", "--channels", "4"),
        *("--layout", "split", "--unit", "gpu", "--minutes", "2.5", "--policy", "latest", "--edge", "triple"),
        *("--batch", "3", "--gpu-share", "0", "--performance-profile", "power_saver", "--governor", "step_wise"),
        *("--what-if", "--plot", "heat.svg", "--json"),
    ): (
        (OWN, "power_saver", 2.5, "step_wise", NOTHING),
        {
            "profile": ("mine",),
            "what_if": (CHIP, SPEC, "gpu", "power_saver", None),
            "draw": (CHIP, OWN, "power_saver", 2.5, "step_wise", Path("heat.svg")),
            "shown": (ANSWER.model_copy(update={"alternatives": ("alternatives",)}), True),
        },
    ),
    ("--gpu-share", "0.25"): ((replace(USUAL, gpu_share=0.25), SUSTAINED, 0.0, None, NOTHING), {}),
    ("--plot", "heat.svg", "--policy", "sequential"): (  # a drawing is of half an hour where no time is given
        (replace(USUAL, variant=Variant("sequential", "double", 1)), SUSTAINED, 0.0, None, NOTHING),
        {
            "draw": (
                *(CHIP, replace(USUAL, variant=Variant("sequential", "double", 1)), SUSTAINED, 30.0, None),
                Path("heat.svg"),
            )
        },
    ),
    ("--fps", "24", "--power-limit-w", "3.5", "--what-if"): (
        (replace(USUAL, variant=AS_A_RUN._replace(fps=24.0)), SUSTAINED, 0.0, None, Wanted(24.0, 3.5)),
        {"what_if": (CHIP, USUAL.network, "dsp", SUSTAINED, 24.0)},
    ),
}


@pytest.mark.parametrize("words", ASKED, ids=" ".join)
def test_every_option_arrives_where_it_belongs(words: tuple[str, ...], asked: dict[str, Any], command: Command) -> None:
    command("predict", *words)
    given, others = ASKED[words]
    assert asked["predict"] == (CHIP, *given)
    assert {name: asked[name] for name in others} == others
    assert {"what_if", "draw"} & asked.keys() == {"what_if", "draw"} & others.keys()


def test_this_machine_is_not_capped_unless_it_is_said(asked: dict[str, Any], command: Command) -> None:
    command("predict", "--profile", "host")
    assert asked["predict"][2] == BURST
    command("predict", "--profile", "host", "--performance-profile", SUSTAINED)
    assert asked["predict"][2] == SUSTAINED


def test_a_precision_is_that_of_the_unit(asked: dict[str, Any], command: Command) -> None:
    command("predict", "--precision", "float")
    assert asked["predict"][0].units["dsp"].precision == "fp16" and CHIP.units["dsp"].precision == "int8"


def test_the_network_of_an_avatar_or_a_file(tiny_bundle: Path, asked: dict[str, Any], command: Command) -> None:
    """Both are the same network; only its file is read as any graph is."""
    work = count_work(load_bundle(tiny_bundle).read_network().model)
    for words, facts in (
        (("--avatar", tiny_bundle), {"avatar": str(tiny_bundle)}),
        (("--network", tiny_bundle / "network.onnx", "--application"), {"network": f"{tiny_bundle}/network.onnx"}),
    ):
        command("predict", *words, "--layout", "split")
        assert asked["predict"][1].network == Network(facts, 64, 64, 5, "split", work)
        assert asked["predict"][2] == SUSTAINED, "the application's, with a network of one's own too"


def test_networks_by_themselves(
    tiny_bundle: Path, tmp_path: Path, asked: dict[str, Any], monkeypatch: pytest.MonkeyPatch, command: Command
) -> None:
    """Each is read on its own, priced in the precision of its numbers, and nothing of the application is asked."""
    monkeypatch.setattr(profile_files, "load_runnable", lambda _: CHIP)
    file = tiny_bundle / "network.onnx"
    words = ("predict", "--network", file, "--network", file, "--fps", 20, "--json")
    found = json.loads(command(*words)[0])
    assert [each["file"] for each in found["networks"]] == [str(file)] * 2
    assert found["networks"][0] == found["networks"][1]
    assert found["networks"][0]["precision"] == "int8" and found["config"]["fps"] == 20
    assert found["config"]["performance_profile"] == BURST, "as published latencies are"
    capped = json.loads(command(*words, "--performance-profile", SUSTAINED, "--runtime", "qnn_dlc")[0])
    assert capped["config"]["performance_profile"] == SUSTAINED
    assert [each["engine_runtime"] for each in capped["networks"]] == ["qnn_dlc"] * 2
    assert found["networks"][0]["engine_runtime"] == "tflite"
    slow = json.loads(command(*words, "--precision", "float", "--unit", "cpu")[0])["networks"][0]
    assert (slow["precision"], slow["unit"]) == ("fp16", "cpu")
    assert command("predict", "--network", file, "--input-shape", "other=1x2", code=2)[1] == (
        "error: --input-shape: found no input 'other', expected one of tensor\n"
    )
    (tmp_path / "cut.onnx").write_bytes(file.read_bytes()[:5000])
    out, err = command("predict", "--network", file, "--network", tmp_path / "cut.onnx", code=2)
    assert out == "" and err.startswith(f"error: {tmp_path / 'cut.onnx'}: found bytes that do not parse, expected")
    assert "predict" not in asked


@pytest.mark.parametrize(("edge", "batch"), [(None, 1), (REFERENCE.edge, 4)])
def test_the_reference_keeps_its_edge(edge: str | None, batch: int) -> None:
    assert PredictOptions(encoder="resnet18", edge=edge, batch=batch).variant == REFERENCE._replace(batch=batch)


ONE = "expected one or the other"
REFUSED = {
    ("--unit", "npu"): "--unit: found 'npu', expected gpu or dsp",
    ("--governor", "x"): "--governor: found 'x', expected step_wise or power_allocator",
    ("--norm", "batch", "--edge", "triple"): (
        f"--edge: found 'triple', expected {REFERENCE.edge}, which the reference application has; "
        "choose a --policy of your own, such as pipelined"
    ),
    ("--network", "n", "--avatar", "a"): "options: found --avatar beside --network, expected one or the other; "
    "the file says so itself",
    ("--network", "n", "--input-shape", "x=1", "--input-shape", "x=2"): "--input-shape: found 'x' twice, expected each "
    "input once",
    ("--network", "n", "--policy", "latest", "--batch", "2"): (
        "options: found --batch, --policy with a network by itself, expected it without them; "
        "they belong to the application: add --application for it with this network"
    ),
    ("--application",): (
        "options: found --application with 0 networks, expected one --network; "
        "it says that the application runs the network of the file"
    ),
    ("--network", "n", "--runtime", "snpe"): "--runtime: found 'snpe', expected tflite or qnn_dlc",
    **{
        ("--minutes", each): f"--minutes: found '{each}', expected minutes, from 0 to 1440"
        for each in ("-1", "nan", "1441", "soon")
    },
    ("--network", "n", "--application", "--runtime", "tflite"): (
        "options: found --runtime, expected a --network by itself beside it; the application runs as its profile says"
    ),
    ("--fps", "0"): "--fps: found 0, expected 0.001 to 1000",
    ("--power-limit-w", "-1"): "--power-limit-w: found -1, expected watts above 0",
    ("--precision", "int4"): "--precision: found 'int4', expected w8a8 (int8), float (fp16) or fp32",
    ("--input-shape", "image=1"): (
        "options: found --input-shape without --network, expected a network whose input it is"
    ),
    ("--network", "n", "--input-shape", "image=1x0"): (
        "--input-shape: found 'image=1x0', expected a name and sizes, such as image=1x3x224x224"
    ),
    ("--avatar", "a", "--layout", "odd"): "--layout: found 'odd', expected packed or split",
    **{
        (f"--{option}", "x", f"--{other}", "1"): f"options: found --{other} beside --{option}, {ONE}; {why}"
        for option, why in (
            ("avatar", "the avatar's network says so itself"),
            ("network", "the file says so itself"),
            ("table", "each row says so itself"),
        )
        for other in ("encoder", "norm", "size", "channels")
    },
    **{
        (
            "--table",
            "x",
            f"--{other}",
            value,
        ): f"options: found --{other} beside --table, {ONE}; each row says so itself"
        for other, value in (
            *((name, "1") for name in ("avatar", "network", "unit", "minutes", "gpu-share", "plot")),
            *(("layout", "split"), ("governor", "step_wise")),
        )
    },
    ("--table", "x", "--what-if", "--norm", "a", "--gpu-share", "1"): (
        f"options: found --gpu-share, --norm, --what-if beside --table, {ONE}; each row says so itself"
    ),
}


@pytest.mark.parametrize("options", REFUSED, ids=" ".join)
def test_refusals_word_by_word(options: tuple[str, ...], asked: dict[str, Any], command: Command) -> None:
    assert command("predict", *options, code=2) == ("", f"error: {REFUSED[options]}\n")
    assert "predict" not in asked


ROWS = [
    {
        "encoder": encoder,
        "norm": "batch",
        "size": "512",
        "channels": "16",
        "layout": "packed",
        **{key: 10.25 * (n + 1) + place for n, key in enumerate(predict_output.SHOWN[:-1])},
        "confidence": 0.876 - place / 10,
    }
    for place, encoder in enumerate(("resnet18", "mobilenetv2"))
]


@pytest.mark.usefixtures("asked")
def test_a_table_of_answers(
    monkeypatch: pytest.MonkeyPatch, command: Command, check_printed: Callable[..., None]
) -> None:
    given: list[Any] = []

    def predict_table(*arguments: Any) -> Any:
        given.append(arguments[:-1])
        arguments[-1](1)
        return iter(ROWS)

    monkeypatch.setattr(reference_networks, "read_table", lambda path: [path] * 2)
    monkeypatch.setattr(predictions, "predict_table", predict_table)
    words = ("predict", "--table", "rows.csv", "--policy", "latest", "--batch", 2, "--performance-profile", "balanced")
    check_printed("predict-table", command(*words)[0])
    assert given == [(CHIP, [Path("rows.csv")] * 2, "balanced", Variant("latest", "double", 2))]
    assert json.loads(command(*words, "--json")[0]) == {
        "schema": 1,
        "clock": "virtual",
        "profile": "chip",
        "performance_profile": "balanced",
        "rows": ROWS,
    }


POWER = {
    **{"w": 3.215, "low_w": 2.115, "high_w": 4.325},
    "units": {"gpu": {"w": 0.515, "low_w": 0.415, "high_w": 0.625}, "dsp": {"w": 1.5, "low_w": 0.755, "high_w": 2.25}},
    "base": {"w": 1.2, "low_w": 0.6, "high_w": 1.9, "kind": "assumed"},
}
RATE = {
    **{"fps": 30.0, "holds": True, "words": "holds", "sentence": "holds 30 fps: yes; 21-30 ms of 33.3 ms (80 %)"},
    **{"reserve": 0.255, "reserve_low": 0.1, "reserve_high": 0.375},
}
LIMIT = {
    **{"limit_w": 3.0, "fps": 28.76, "low_fps": 20.34, "high_fps": 33.3, "power_w": 2.995, "limited_by": "power"},
    "idle_w": 2.5,
    "corners": {"gpu": "svs", "dsp": "max"},
}


def an_answer(**changes: Any) -> dict[str, Any]:
    idle = {"starved": 0.101, "blocked": 0.202, "throttled": 0.0, "preempted": 0.003, "overhead": 0.044}
    return {
        **{"schema": 1, "clock": "virtual", "machine": {"profile": "chip", "title": "A Chip"}},
        "config": {
            **{"encoder": "resnet18", "norm": "batch", "size": "64x32", "channels": 4, "layout": "packed"},
            **{"unit": "gpu", "policy": "pipelined", "edge": "single", "performance_profile": "burst", "minutes": 0.0},
            **{"batch": 1, "fps": 30.0, "gpu_share": 0.0, "governor": "step_wise"},
        },
        "network": {
            **{"gmac": 1.25, "parameters_m": 2.35, "alone_ms": 3.45, "low_ms": 3.05, "high_ms": 3.95},
            **{"parts_ms": {"fixed": 3.45}, "why": []},
        },
        "frame_time_ms": {
            **dict.fromkeys(("p50", "p90", "p95", "p99", "max"), 4.55),
            **{"mean": 4.55, "ema20_min": 4.15, "ema20_max": 5.75, "low": 4.25, "high": 4.95},
        },
        **{"latency_ms": {"mean": 6.85}, "fps": 219.78, "fps_settled": 200.12, "fps_start": 230.34},
        **{"efficiency": 0.756, "display_capped": False, "power_w": 3.21, "power": POWER, "notes": []},
        **{"base_power_w": 1.2, "base_power_kind": "assumed", "energy_mj_per_frame": 14.6, "xrbench": {"energy": 0.9}},
        **{"temperature_c": {}, "caps": {"throttled_share": 0.0, "first_throttled_s": None}, "timeline": []},
        "stages": {"infer": {"unit": "gpu", "service_ms": {"mean": 0.0}}},
        **{"expected_error": 0.123, "confidence": 0.877},
        "units": {"gpu": {"busy": 0.65, "idle": idle}, "dsp": {"busy": 0.25, "idle": {"throttled": 0.755}}},
        **changes,
    }


def alternative(name: str, policy: str, edge: str, *figures: float, holds: bool) -> dict[str, Any]:
    keys = ("frame_ms", "fps", "latency_ms", "dropped", "power_w")
    return {"name": name, "policy": policy, "edge": edge, "holds": holds, **dict(zip(keys, figures, strict=True))}


def everything() -> dict[str, Any]:
    """Of an avatar for ten minutes, hot, held by the display, with notes and alternatives."""
    return an_answer(
        config={**an_answer()["config"], "avatar": "someone", "network": "a.onnx", "minutes": 10.0},
        **{"display_capped": True, "notes": ["first", "second"], "rate": RATE, "power_limit": LIMIT},
        temperature_c={"device_max": 41.25, "junction_max": 77.75},
        caps={"throttled_share": 0.125, "first_throttled_s": 4.0},
        timeline=[{"t_s": 1.0}],
        alternatives=[
            alternative("newest", "latest", "triple", 7.77, 128.7, 9.99, 0.125, 4.565, holds=True),
            alternative("slow", "sequential", "single", 17.7, 56.5, 18.8, 0.0, 2.345, holds=False),
        ],
    )


@pytest.mark.parametrize(("name", "answer"), [("least", an_answer()), ("everything", everything())])
def test_an_answer_is_shown(
    name: str, answer: dict[str, Any], capsys: pytest.CaptureFixture[str], check_printed: Callable[..., None]
) -> None:
    prediction = ApplicationPrediction.model_validate(answer)
    predict_output.show_answer(prediction, as_json=False)
    check_printed(f"predict-{name}", capsys.readouterr().out)
    predict_output.show_answer(prediction, as_json=True)
    assert json.loads(capsys.readouterr().out) == answer | {"verdict": predicted_verdict(prediction).shown()}


def a_network(**changes: Any) -> dict[str, Any]:
    operator = {"op_type": "Conv", "share": 0.1, "bound": "arithmetic", "macs": 1, "elements": 1}
    return {
        **{"file": "folder/net.onnx", "unit": "dsp", "numbers": "w8a8", "precision": "int8"},
        "engine_runtime": "tflite",
        **{"gmac": 1.255, "parameters_m": 2.355, "network_ms": 3.456, "low_ms": 3.012, "high_ms": 3.987},
        **{"fps": 289.35, "job_ms": 0.5, "why": ["as it is"], "without_rule": [], "power": POWER},
        "operators": [{"name": f"n{n}", "ms": 0.1 * n, **operator} for n in range(12)],
        **changes,
    }


def test_networks_are_shown_with_their_ten_most_expensive_operators(
    capsys: pytest.CaptureFixture[str], check_printed: Callable[..., None]
) -> None:
    asked = PredictOptions(performance_profile="burst", minutes=30.0, fps=30.0, power_limit_w=3.0)
    over = {"fps_settled": 25.55, "fps_start": 40.0, "caps": CAPS, "without_rule": [ODD]}
    heat = {"device_max": 41.25, "junction_max": 77.75}
    rate = {**RATE, "holds": False, "reserve": -0.5, "reserve_low": -0.75, "reserve_high": -0.255, "sentence": "no"}
    answers = [a_network(rate=RATE, temperature_c=heat, **over)]
    answers.append(
        a_network(**over, engine_runtime=None, temperature_c=heat, numbers="not said", rate=rate, power_limit=LIMIT)
    )
    predictions = [NetworkPrediction.model_validate(answer) for answer in answers]
    predict_output.show_networks(CHIP, asked, predictions, as_json=False)
    check_printed("predict-networks", capsys.readouterr().out)
    predict_output.show_networks(CHIP, asked, predictions, as_json=True)
    assert json.loads(capsys.readouterr().out) == {
        "schema": 1,
        "clock": "virtual",
        "machine": {"profile": "chip", "title": "A Chip"},
        "config": {
            **{"performance_profile": "burst", "minutes": 30.0, "governor": CHIP.thermal.governor},
            **{"fps": 30.0, "power_limit_w": 3.0},
        },
        "networks": [
            answer | {"verdict": predicted_verdict(each).shown()}
            for answer, each in zip(answers, predictions, strict=True)
        ],
    }


def test_a_limit_below_what_an_idle_device_takes(capsys: pytest.CaptureFixture[str]) -> None:
    limit = {**LIMIT, "fps": 0.0, "low_fps": 0.0, "high_fps": 0.0, "power_w": 3.25}
    predict_output.show_answer(ApplicationPrediction.model_validate(an_answer(power_limit=limit)), as_json=False)
    assert "within 3 W      never: the device takes 3.25 W when no unit works\n" in capsys.readouterr().out


CAPS = {"throttled_share": 0.5, "first_throttled_s": 4.0}
ODD = {"op_type": "Warp", "count": 3, "share_of_elements": 0.125}


@pytest.mark.parametrize(("asked_for", "names"), [("balanced", 3), (BURST, 2), (SUSTAINED, 2)])
def test_a_drawing_has_the_usual_profiles_beside_the_one_asked_for(
    asked_for: str, names: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    drawn: list[Any] = []
    monkeypatch.setattr(governor, "over_time", lambda *given: given)
    monkeypatch.setattr(governor, "plot_over_time", lambda *given: drawn.append(given))
    network: Any = SimpleNamespace(facts={"encoder": "resnet18", "norm": "batch"}, height=64, width=32, channels=4)
    plan = Plan(network, "gpu")
    chip: Any = SimpleNamespace(
        title="A Chip", thermal=SimpleNamespace(skin_limit_c=SimpleNamespace(or_else=lambda other: 43.5 + other))
    )
    predict_output.draw(chip, plan, asked_for, 5.0, "step_wise", Path("heat.svg"))
    runs = {name: (chip, plan, name, 5.0, "step_wise") for name in [SUSTAINED, BURST, asked_for]}
    assert drawn == [(runs, 43.5, "A Chip\nresnet18, batch, 64x32x4 on the gpu", Path("heat.svg"))]
    assert list(drawn[0][0])[:2] == [SUSTAINED, BURST] and len(drawn[0][0]) == names
