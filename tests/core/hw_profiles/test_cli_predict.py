"""`trilane predict`: what its options ask for, each refusal, and what is printed of rates, powers and networks."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import onnx
import pytest

from support.pipeline_files import additions
from support.small_inputs import net
from trilane.apps.cli import predict_output
from trilane.apps.predict.asked_prediction import application_of
from trilane.apps.predict.predict_options import PredictOptions
from trilane.avatars.bundle import load_bundle
from trilane.hw_profiles import governor
from trilane.hw_profiles.application import REFERENCE
from trilane.hw_profiles.network_work import count_work
from trilane.hw_profiles.predict import predict_table
from trilane.hw_profiles.profile_files import load_profile
from trilane.hw_profiles.reference_networks import read_table
from trilane.units import BURST, SUSTAINED

Command = Callable[..., tuple[str, str]]
CHIP = ("--profile", "snapdragon-8-gen-3")

AS_A_RUN = {"policy": "pipelined", "edge": "double", "batch": 1, "fps": 30.0, "gpu_share": 0.0}
AS_PUBLISHED = {"policy": REFERENCE.policy, "edge": REFERENCE.edge, "batch": REFERENCE.batch, "gpu_share": 0.0}
USUAL = {"avatar": "default", "layout": "packed", "unit": "dsp", "performance_profile": SUSTAINED, "minutes": 0.0}
PUBLISHED = {"encoder": "resnet18", "norm": "batch", "size": "512x512", "channels": 16, **USUAL}
del PUBLISHED["avatar"]
OWN = {"encoder": "mobilenetv2", "norm": "group", "size": "96x64", "channels": 4, "layout": "split", "unit": "gpu"}
OWN |= {"minutes": 2.5, "policy": "latest", "edge": "triple", "batch": 3, "gpu_share": 0.0}
OWN |= {"performance_profile": "power_saver", "governor": "power_allocator"}
#: Words of a command -> what the answer says that was asked, and which parts it has besides.
ASKED: dict[tuple[str, ...], tuple[dict[str, Any], set[str]]] = {
    (): (USUAL | AS_A_RUN, set()),
    ("--encoder", "resnet18"): (PUBLISHED | AS_PUBLISHED, set()),
    ("--size", "512", "--policy", "pipelined"): (PUBLISHED | AS_A_RUN, set()),
    (
        *("--encoder", "mobilenetv2", "--norm", "group", "--size", "96x64", "--channels", "4", "--layout", "split"),
        *("--unit", "gpu", "--minutes", "2.5", "--policy", "latest", "--edge", "triple", "--batch", "3"),
        *("--gpu-share", "0", "--performance-profile", "power_saver", "--governor", "power_allocator", "--what-if"),
    ): (OWN, {"alternatives"}),
    ("--gpu-share", "0.25"): (USUAL | AS_A_RUN | {"gpu_share": 0.25}, set()),
    ("--fps", "24", "--power-limit-w", "3.5", "--what-if"): (
        USUAL | AS_A_RUN | {"fps": 24.0},
        {"alternatives", "rate", "power_limit"},
    ),
}


@pytest.mark.parametrize("words", ASKED, ids=" ".join)
def test_every_option_arrives_where_it_belongs(words: tuple[str, ...], command: Command) -> None:
    answer = json.loads(command("predict", *CHIP, *words, "--json")[0])
    config, parts = ASKED[words]
    assert answer["config"] == answer["config"] | config
    assert {"alternatives", "rate", "power_limit"} & answer.keys() == parts
    if parts >= {"rate", "power_limit"}:
        assert (answer["rate"]["fps"], answer["power_limit"]["limit_w"]) == (24.0, 3.5)
        assert all("holds" in row for row in answer["alternatives"])
    assert answer["machine"]["profile"] == CHIP[1]


def test_this_machine_is_not_capped_unless_it_is_said() -> None:
    assert PredictOptions(profile="host").cap == BURST
    assert PredictOptions(profile="host", performance_profile=SUSTAINED).cap == SUSTAINED


def test_a_precision_is_that_of_the_unit() -> None:
    chip = load_profile("snapdragon-888")
    found, _ = application_of(chip, PredictOptions(precision="float"))
    assert (chip.units["dsp"].precision, found.units["dsp"].precision) == ("int8", "fp16")


def test_the_network_of_an_avatar_or_a_file(tiny_bundle: Path, command: Command) -> None:
    """Both are the same network; only its file is read as any graph is."""
    work = count_work(load_bundle(tiny_bundle).read_network().model)
    for words, facts in (
        (("--avatar", tiny_bundle), {"avatar": str(tiny_bundle)}),
        (("--network", tiny_bundle / "network.onnx", "--application"), {"network": f"{tiny_bundle}/network.onnx"}),
    ):
        answer = json.loads(command("predict", *CHIP, *words, "--layout", "split", "--json")[0])
        config = facts | {"size": "64x64", "channels": 5, "layout": "split", "performance_profile": SUSTAINED}
        assert answer["config"] == answer["config"] | config
        assert (answer["network"]["gmac"], answer["network"]["parameters_m"]) == (work.macs / 1e9, work.weights / 1e6)


def test_networks_by_themselves(tiny_bundle: Path, tmp_path: Path, command: Command) -> None:
    """Each is read on its own and priced in the precision of its numbers."""
    file = tiny_bundle / "network.onnx"
    words = ("predict", *CHIP, "--network", file, "--network", file, "--fps", 20, "--json")
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
def test_refusals_word_by_word(options: tuple[str, ...], command: Command) -> None:
    assert command("predict", *options, code=2) == ("", f"error: {REFUSED[options]}\n")


@pytest.fixture
def in_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    return tmp_path


def test_a_table_of_answers(in_folder: Path, command: Command, check_printed: Callable[..., None]) -> None:
    (in_folder / "rows.csv").write_text(
        "encoder,norm,size,channels,layout\nresnet18,batch,512,16,packed\nmobilenetv2,group,96x64,4,split\n"
    )
    words = ("predict", *CHIP, "--table", "rows.csv", "--policy", "latest", "--batch", 2)
    words += ("--performance-profile", "balanced")
    check_printed("predict-table", command(*words)[0])
    variant = PredictOptions(table=Path("rows.csv"), policy="latest", batch=2).variant
    rows = [*predict_table(load_profile(CHIP[1]), read_table(in_folder / "rows.csv"), "balanced", variant)]
    assert json.loads(command(*words, "--json")[0]) == {
        "schema": 1,
        "clock": "virtual",
        "profile": CHIP[1],
        "performance_profile": "balanced",
        "rows": rows,
    }


LIMITS: dict[str, tuple[str, ...]] = {
    "predict-rate": ("--encoder", "resnet18", "--fps", "24", "--power-limit-w", "2", "--minutes", "10", "--what-if"),
    "predict-never": ("--encoder", "resnet18", "--fps", "240", "--power-limit-w", "0.5"),
    "predict-networks": ("--network", "small.onnx", "--network", "odd.onnx", "--fps", "400", "--minutes", "30"),
}


@pytest.mark.parametrize("name", LIMITS)
def test_what_is_printed_of_rates_powers_and_networks(
    name: str, in_folder: Path, command: Command, check_printed: Callable[..., None]
) -> None:
    """One network holds the rate. The other one does not, and has an operator that nobody knows."""
    onnx.save(net(), in_folder / "small.onnx")
    odd = additions(512)
    odd.graph.value_info.append(onnx.helper.make_tensor_value_info("odd", onnx.TensorProto.FLOAT, (1, 32, 512, 512)))
    odd.graph.node.append(onnx.helper.make_node("Warp", [odd.graph.output[0].name], ["odd"], domain="mine"))
    odd.graph.output[0].name = "odd"
    odd.opset_import.append(onnx.helper.make_opsetid("mine", 1))
    onnx.save(odd, in_folder / "odd.onnx")
    check_printed(name, command("predict", *CHIP, *LIMITS[name])[0])


@pytest.mark.parametrize(
    ("words", "names", "minutes"),
    [
        ((), [SUSTAINED, BURST], 30),
        (("--performance-profile", BURST, "--minutes", "5"), [SUSTAINED, BURST], 5),
        (("--performance-profile", "balanced", "--minutes", "5"), [SUSTAINED, BURST, "balanced"], 5),
    ],
)
def test_a_drawing_has_the_usual_profiles_beside_the_one_asked_for(
    words: tuple[str, ...], names: list[str], minutes: int, command: Command, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It is of half an hour where no time is given."""
    drawn: list[Any] = []
    monkeypatch.setattr(governor, "plot_over_time", lambda *given: drawn.append(given))
    real, asked = governor.over_time, list[Any]()
    monkeypatch.setattr(governor, "over_time", lambda *given: asked.append(given) or real(*given))
    drawing = ("--encoder", "resnet18", "--size", "64x32", "--plot", "heat.svg")
    command("predict", *CHIP, *drawing, *words, "--governor", "power_allocator", "--policy", "sequential")
    ((runs, limit_c, title, path),) = drawn
    chip = load_profile(CHIP[1])
    assert list(runs) == names
    assert {round(moments[-1].t_s / 60) for moments in runs.values()} == {minutes}
    title_of = f"{chip.title}\nresnet18, batch, 64x32x16 on the dsp"
    assert (limit_c, title, path) == (chip.thermal.skin_limit_c.value, title_of, Path("heat.svg"))
    assert {(each[1].variant.policy, each[4]) for each in asked} == {("sequential", "power_allocator")}


def test_alternatives_are_of_the_performance_profile(command: Command) -> None:
    words = ("predict", "--profile", "snapdragon-888", "--size", "512", "--what-if", "--json")
    slow, fast = (
        json.loads(command(*words, "--performance-profile", cap)[0])["alternatives"][0]["frame_ms"]
        for cap in ("power_saver", BURST)
    )
    assert slow > fast


def test_an_alternative_that_drops_frames() -> None:
    assert predict_output._at_rate({"holds": False, "dropped": 0.25, "power_w": 2.5}) == ("no", "25 %", "2.50")
