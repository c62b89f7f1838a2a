"""`trilane predict` beside doubles of what predicts: what is asked, each refusal, and answers that a test wrote."""

from __future__ import annotations

import io
import json
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import onnx
import pytest

from trilane.apps.cli import predict as cli
from trilane.apps.cli import predict_output
from trilane.apps.predict import asked_prediction
from trilane.apps.predict.predict_options import PredictOptions
from trilane.avatars.bundle import load_bundle
from trilane.errors import BadInputError
from trilane.hw_profiles import over_time, plot, profile_files, reference_networks
from trilane.hw_profiles import predict as predictions
from trilane.hw_profiles.application import REFERENCE, Plan, Variant
from trilane.hw_profiles.network_work import Network, count_work
from trilane.hw_profiles.rates import NOTHING, Wanted
from trilane.hw_profiles.reference_networks import NetworkSpec
from trilane.units import BURST, SUSTAINED

Command = Callable[..., tuple[str, str]]
CHIP = profile_files.load_profile("snapdragon-888").model_copy(update={"name": "chip", "title": "A Chip"})


@pytest.fixture
def asked(monkeypatch: pytest.MonkeyPatch) -> dict[str, Any]:
    """What the command asked of its parts, by their names."""
    found: dict[str, Any] = {}

    def answer(chip: Any, plan: Plan, *others: Any) -> dict[str, Any]:
        found["predict"] = (chip, plan, *others)
        return {"fps": 12.5}

    def what_if(*given: Any) -> list[str]:
        found["what_if"] = given
        return ["alternatives"]

    def draw(*given: Any) -> None:
        found["draw"] = given

    def show(answer: Any, as_json: bool) -> None:
        found["shown"] = (answer, as_json)

    monkeypatch.setattr(profile_files, "load_runnable", lambda name: found.setdefault("profile", name) and CHIP)
    monkeypatch.setattr(predictions, "predict", answer)
    monkeypatch.setattr(predictions, "what_if", what_if)
    monkeypatch.setattr(cli, "draw", draw)
    monkeypatch.setattr(cli, "show_answer", show)
    monkeypatch.setattr("trilane.hw_profiles.reference_networks.reference_network", lambda spec: spec)
    return found


USUAL = NetworkSpec("resnet18", "batch", 512, 512, 16, "packed")


def test_without_options(asked: dict[str, Any], command: Command) -> None:
    command("predict")
    assert asked["profile"] == "snapdragon-888"
    assert asked["predict"] == (CHIP, Plan(USUAL, "dsp", REFERENCE, 0.0), SUSTAINED, 0.0, None, NOTHING)  # type: ignore[arg-type]
    assert asked["shown"] == ({"fps": 12.5}, False)
    assert "what_if" not in asked and "draw" not in asked


def test_every_option_arrives_where_it_belongs(asked: dict[str, Any], command: Command) -> None:
    command(
        *("predict", "--profile", "mine", "--encoder", "mobilenetv2", "--norm", "group", "--size", "96x64"),
        *("--channels", 4, "--layout", "split", "--runtime", "gpu", "--minutes", 2.5, "--policy", "latest"),
        *("--edge", "triple", "--batch", 3, "--gpu-share", 0, "--performance-profile", "power_saver"),
        *("--governor", "step_wise", "--what-if", "--plot", "heat.svg", "--json"),
    )
    spec: Any = NetworkSpec("mobilenetv2", "group", 96, 64, 4, "split")
    plan = Plan(spec, "gpu", Variant("latest", "triple", 3), 0.0)
    assert asked["profile"] == "mine"
    assert asked["predict"] == (CHIP, plan, "power_saver", 2.5, "step_wise", NOTHING)
    assert asked["what_if"] == (CHIP, spec, "gpu", "power_saver", None)
    assert asked["draw"] == (CHIP, plan, "power_saver", 2.5, "step_wise", Path("heat.svg"))
    assert asked["shown"] == ({"fps": 12.5, "alternatives": ["alternatives"]}, True)
    command("predict", "--gpu-share", 0.25)
    assert asked["predict"][1].gpu_share == 0.25


def test_a_drawing_is_of_half_an_hour_where_no_time_is_given(asked: dict[str, Any], command: Command) -> None:
    command("predict", "--plot", "heat.svg", "--policy", "pipelined")
    assert asked["draw"][2:] == (SUSTAINED, 30.0, None, Path("heat.svg"))
    assert asked["predict"][1].variant == Variant("pipelined", "double", 1)


def test_this_machine_is_not_capped_unless_it_is_said(asked: dict[str, Any], command: Command) -> None:
    command("predict", "--profile", "host")
    assert asked["predict"][2] == BURST
    command("predict", "--profile", "host", "--performance-profile", SUSTAINED)
    assert asked["predict"][2] == SUSTAINED


def test_the_network_of_an_avatar_or_a_file(tiny_bundle: Path, asked: dict[str, Any], command: Command) -> None:
    """Both are the same network; only its file is read as any graph is."""
    work = count_work(load_bundle(tiny_bundle).read_network().model)
    file = tiny_bundle / "network.onnx"
    command("predict", "--avatar", tiny_bundle, "--layout", "split")
    assert asked["predict"][1].network == Network({"avatar": str(tiny_bundle)}, 64, 64, 5, "split", work)
    command("predict", "--network", file, "--application", "--layout", "split")
    assert asked["predict"][1].network == Network({"network": str(file)}, 64, 64, 5, "split", work)
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
    capped = json.loads(command(*words, "--performance-profile", SUSTAINED, "--engine-runtime", "qnn_dlc")[0])
    assert capped["config"]["performance_profile"] == SUSTAINED
    assert [each["engine_runtime"] for each in capped["networks"]] == ["qnn_dlc"] * 2
    assert found["networks"][0]["engine_runtime"] == "tflite"
    slow = json.loads(command(*words, "--precision", "float", "--runtime", "cpu")[0])["networks"][0]
    assert (slow["precision"], slow["unit"]) == ("fp16", "cpu")
    assert command("predict", "--network", file, "--input-shape", "other=1x2", code=2)[1] == (
        "error: --input-shape: found no input 'other', expected one of tensor\n"
    )
    (tmp_path / "cut.onnx").write_bytes(file.read_bytes()[:5000])
    out, err = command("predict", "--network", file, "--network", tmp_path / "cut.onnx", code=2)
    assert out == "" and err.startswith(f"error: {tmp_path / 'cut.onnx'}: found bytes that do not parse, expected")
    assert "predict" not in asked


def test_a_rate_a_limit_and_a_precision(asked: dict[str, Any], command: Command) -> None:
    command("predict", "--fps", 24, "--power-limit-w", 3.5, "--what-if", "--precision", "float")
    chip, plan, *_, wanted = asked["predict"]
    assert wanted == Wanted(24.0, 3.5) and plan.variant == REFERENCE
    assert asked["what_if"][-1] == 24.0
    assert chip.units["dsp"].precision == "fp16" and CHIP.units["dsp"].precision == "int8"


@pytest.mark.parametrize(("edge", "batch"), [(None, 1), (REFERENCE.edge, 4)])
def test_the_reference_keeps_its_edge(edge: str | None, batch: int) -> None:
    assert PredictOptions(edge=edge, batch=batch).variant == REFERENCE._replace(batch=batch)


ONE = "expected one or the other"
REFUSED = {
    ("--runtime", "npu"): "--runtime: found 'npu', expected gpu or dsp",
    ("--governor", "x"): "--governor: found 'x', expected step_wise or power_allocator",
    ("--edge", "triple"): (
        f"--edge: found 'triple', expected {REFERENCE.edge}, which the reference application has; "
        "choose a --policy of your own, such as pipelined"
    ),
    ("--network", "n", "--avatar", "a"): "options: found --avatar beside --network, expected one or the other; "
    "the file says so itself",
    ("--network", "n", "--input-shape", "x=1", "--input-shape", "x=2"): "--input-shape: found 'x' twice, expected each "
    "input once",
    ("--network", "n", "--policy", "latest", "--batch", "2"): (
        "options: found --batch, --policy with a network by itself, expected it without them; "
        "they are of the application: add --application for it with this network"
    ),
    ("--application",): (
        "options: found --application with 0 networks, expected one --network; "
        "it says that the application runs the network of the file"
    ),
    ("--network", "n", "--engine-runtime", "snpe"): "--engine-runtime: found 'snpe', expected tflite or qnn_dlc",
    ("--network", "n", "--application", "--engine-runtime", "tflite"): (
        "options: found --engine-runtime, expected a --network by itself beside it; "
        "the application runs as its profile says"
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
            *((name, "1") for name in ("avatar", "network", "runtime", "minutes", "gpu-share", "plot")),
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


@pytest.mark.usefixtures("asked")
def test_a_table_has_a_bar_on_a_terminal(monkeypatch: pytest.MonkeyPatch, command: Command) -> None:
    from rich.console import Console

    def predict_table(*arguments: Any) -> Any:
        arguments[-1](2)
        return iter(ROWS)

    screen = io.StringIO()
    console = Console(file=screen, force_terminal=True, width=100)
    monkeypatch.setattr(cli, "stderr_console", lambda: console)
    monkeypatch.setattr(reference_networks, "read_table", lambda _: [0] * 4)
    monkeypatch.setattr(predictions, "predict_table", predict_table)
    command("predict", "--table", "rows.csv")
    assert "predicting" in screen.getvalue() and "50%" in screen.getvalue()
    assert screen.getvalue().endswith("\x1b[2K")  # the bar is gone


POWER = {
    **{"w": 3.215, "low_w": 2.115, "high_w": 4.325},
    "units": {"gpu": {"w": 0.515, "low_w": 0.415, "high_w": 0.625}, "dsp": {"w": 1.5, "low_w": 0.755, "high_w": 2.25}},
    "base": {"w": 1.2, "low_w": 0.6, "high_w": 1.9, "kind": "assumed"},
}
RATE = {"fps": 30.0, "holds": True, "words": "holds", "reserve": 0.255, "reserve_low": 0.1, "reserve_high": 0.375}
LIMIT = {
    "limit_w": 3.0,
    "fps": 28.76,
    "low_fps": 20.34,
    "high_fps": 33.3,
    "power_w": 2.995,
    "limited_by": "power",
    "corners": {"gpu": "svs", "dsp": "max"},
}


def an_answer(**changes: Any) -> dict[str, Any]:
    idle = {"starved": 0.101, "blocked": 0.202, "preempted": 0.003, "overhead": 0.044}
    return {
        "machine": {"title": "A Chip"},
        "config": {
            **{"encoder": "resnet18", "norm": "batch", "size": "64x32", "channels": 4, "layout": "packed"},
            **{"runtime": "gpu", "performance_profile": "burst", "minutes": 0.0},
        },
        "network": {"gmac": 1.25, "parameters_m": 2.35, "alone_ms": 3.45, "low_ms": 3.05, "high_ms": 3.95},
        "frame_time_ms": {"mean": 4.55, "ema20_min": 4.15, "ema20_max": 5.75, "low": 4.25, "high": 4.95},
        "latency_ms": {"mean": 6.85},
        "fps": 219.78,
        "fps_settled": 200.12,
        "fps_start": 230.34,
        "efficiency": 0.756,
        "display_capped": False,
        "power_w": 3.21,
        "power": POWER,
        "energy_mj_per_frame": 14.6,
        "notes": [],
        "temperature_c": None,
        "caps": None,
        "expected_error": 0.123,
        "confidence": 0.877,
        "units": {"gpu": {"busy": 0.65, "idle": idle}, "dsp": {"busy": 0.25, "idle": {"throttled": 0.755}}},
        **changes,
    }


def everything() -> dict[str, Any]:
    """Of an avatar for ten minutes, hot, held by the display, with notes and alternatives."""
    config = {**an_answer()["config"], "avatar": "someone", "network": "a.onnx", "minutes": 10.0}
    return an_answer(
        config=config,
        display_capped=True,
        notes=["first", "second"],
        temperature_c={"device_max": 41.25, "junction_max": 77.75},
        caps={"throttled_share": 0.125},
        rate=RATE,
        power_limit=LIMIT,
        alternatives=[
            {
                "name": "newest",
                "policy": "latest",
                "edge": "triple",
                "frame_ms": 7.77,
                "fps": 128.7,
                "latency_ms": 9.99,
                **{"holds": True, "dropped": 0.125, "power_w": 4.565},
            },
            {
                "name": "slow",
                "policy": "sequential",
                "edge": "single",
                "frame_ms": 17.7,
                "fps": 56.5,
                "latency_ms": 18.8,
                **{"holds": False, "dropped": 0.0, "power_w": 2.345},
            },
        ],
    )


@pytest.mark.parametrize(("name", "answer"), [("least", an_answer()), ("everything", everything())])
def test_an_answer_is_shown(
    name: str, answer: dict[str, Any], capsys: pytest.CaptureFixture[str], check_printed: Callable[..., None]
) -> None:
    predict_output.show_answer(answer, as_json=False)
    check_printed(f"predict-{name}", capsys.readouterr().out)
    predict_output.show_answer(answer, as_json=True)
    assert json.loads(capsys.readouterr().out) == answer


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
    over = {"fps_settled": 25.55, "fps_start": 40.0, "caps": {"throttled_share": 0.5}, "without_rule": [ODD]}
    heat = {"device_max": 41.25, "junction_max": 77.75}
    rate = {**RATE, "holds": False, "reserve": -0.5, "reserve_low": -0.75, "reserve_high": -0.255, "words": "no"}
    answers = [a_network(rate=RATE, temperature_c=heat, **over)]
    answers.append(
        a_network(**over, engine_runtime=None, temperature_c=heat, numbers="not said", rate=rate, power_limit=LIMIT)
    )
    predict_output.show_networks(CHIP, asked, answers, as_json=False)
    check_printed("predict-networks", capsys.readouterr().out)
    predict_output.show_networks(CHIP, asked, answers, as_json=True)
    assert json.loads(capsys.readouterr().out) == {
        "schema": 1,
        "clock": "virtual",
        "machine": {"profile": "chip", "title": "A Chip"},
        "config": {
            **{"performance_profile": "burst", "minutes": 30.0, "governor": CHIP.thermal.governor},
            **{"fps": 30.0, "power_limit_w": 3.0},
        },
        "networks": answers,
    }


def test_inputs_that_may_have_another_shape_are_told_without_the_weights(tmp_path: Path) -> None:
    ends = [(n, s) for n, s in (("image", (1, 3, 8, 8)), ("w0", (4, 3, 1, 1)), ("y", (1, 4, 8, 8)))]
    values = [onnx.helper.make_tensor_value_info(name, onnx.TensorProto.FLOAT, shape) for name, shape in ends]
    graph = onnx.helper.make_graph([onnx.helper.make_node("Conv", ["image", "w0"], ["y"])], "g", values[:2], values[2:])
    onnx.save(onnx.helper.make_model(graph, opset_imports=[onnx.helper.make_opsetid("", 17)]), tmp_path / "net.onnx")
    with pytest.raises(BadInputError, match=r"found no input 'picture', expected one of image$"):
        options = PredictOptions(network=(tmp_path / "net.onnx",), input_shape=("picture=1",))
        asked_prediction.predict_networks(CHIP, options)


def test_a_limit_below_what_an_idle_device_takes(capsys: pytest.CaptureFixture[str]) -> None:
    limit = {**LIMIT, "fps": 0.0, "low_fps": 0.0, "high_fps": 0.0, "power_w": 3.25}
    predict_output.show_answer(an_answer(power_limit=limit), as_json=False)
    assert "within 3 W      never: the device takes 3.25 W when no unit works\n" in capsys.readouterr().out


ODD = {"op_type": "Warp", "count": 3, "share_of_elements": 0.125}


@pytest.mark.parametrize(("asked_for", "names"), [("balanced", 3), (BURST, 2), (SUSTAINED, 2)])
def test_a_drawing_has_the_usual_profiles_beside_the_one_asked_for(
    asked_for: str, names: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    drawn: list[Any] = []
    monkeypatch.setattr(over_time, "over_time", lambda *given: given)
    monkeypatch.setattr(plot, "plot_over_time", lambda *given: drawn.append(given))
    network: Any = SimpleNamespace(facts={"encoder": "resnet18", "norm": "batch"}, height=64, width=32, channels=4)
    plan = Plan(network, "gpu")
    chip: Any = SimpleNamespace(
        title="A Chip", thermal=SimpleNamespace(skin_limit_c=SimpleNamespace(or_else=lambda other: 43.5 + other))
    )
    predict_output.draw(chip, plan, asked_for, 5.0, "step_wise", Path("heat.svg"))
    runs = {name: (chip, plan, name, 5.0, "step_wise") for name in [SUSTAINED, BURST, asked_for]}
    assert drawn == [(runs, 43.5, "A Chip\nresnet18, batch, 64x32x4 on the gpu", Path("heat.svg"))]
    assert list(drawn[0][0])[:2] == [SUSTAINED, BURST] and len(drawn[0][0]) == names
