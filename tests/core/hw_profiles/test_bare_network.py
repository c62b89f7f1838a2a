"""Networks by themselves, rates and powers: worked out by hand on a chip of round numbers."""

from __future__ import annotations

import math
from collections.abc import Mapping
from itertools import product
from pathlib import Path
from typing import Any

import onnx
import pytest
from onnx import TensorProto, helper

from support.small_inputs import net
from trilane.errors import BadInputError
from trilane.hw_profiles import network_time
from trilane.hw_profiles.graph_file import image_network, read_graph
from trilane.hw_profiles.network_time import (
    Interval,
    NetworkTime,
    OperatorTime,
    in_precision,
    interval,
    operator_rows,
    predict_network,
    price,
    spread_of,
    under_runtime,
    without_rule,
)
from trilane.hw_profiles.network_work import Operator, Work, count_work
from trilane.hw_profiles.profile_files import load_profile
from trilane.hw_profiles.rates import FrameInterval, FrameLoad, Wanted, answers, device_power, holding, within_power
from trilane.hw_profiles.schema import CORNERS, ENGINE_RUNTIMES, Corners, Profile, Quantity, corners_of
from trilane.units import UNITS, UnitName


def number(value: float, spread: float = 0.0) -> Quantity:
    return Quantity(value=value, kind="assumed", source="by hand", spread=spread)


def chip(spread: float = 0.0, display_ms: float = 16.0) -> Profile:
    """Units of 4 W at their highest clock, 0.5 W idle, with the clock halved from corner to corner; a base of 1 W."""
    profile = load_profile("snapdragon-888")
    corners = {corner: number(0.5**n) for n, corner in enumerate(CORNERS)}
    power = {"power_max_w": number(4.0, spread), "idle_w": number(0.5, spread), "power_exponent": number(2.0)}
    units = {name: unit.model_copy(update={**power, "corners": corners}) for name, unit in profile.units.items()}
    application = profile.application.model_copy(update={"display_ms": number(display_ms)})
    thermal = profile.thermal.model_copy(update={"base_power_w": number(1.0, spread)})
    return profile.model_copy(update={"units": units, "thermal": thermal, "application": application})


TOP: Corners = ("max", "max", "max")


def test_power_is_of_each_unit_and_of_the_base() -> None:
    """The GPU works a quarter of the time at half its clock, with 4 * 0.5^2 = 1 W: 0.25 * 1 + 0.75 * 0.5 W."""
    found = device_power(chip(), {"cpu": 0.0, "gpu": 0.25, "dsp": 1.0}, ("max", "turbo", "max"), {})
    units = {unit: watts.w for unit, watts in found.units.items()}
    assert units == {"cpu": 0.5, "gpu": 0.625, "dsp": 4.0}
    assert found.base.as_json() == {"w": 1.0, "low_w": 1.0, "high_w": 1.0, "kind": "assumed"}
    assert (found.w, found.low_w, found.high_w) == pytest.approx((6.125, 6.125, 6.125))


def test_an_interval_of_power_is_that_of_a_log_normal_number() -> None:
    """Of one number alone, with spread s: quantiles of 10 and 90 % lie exp(+-1.2816 s') from the median."""
    found = device_power(chip(0.3), {"cpu": 0.0, "gpu": 0.0, "dsp": 1.0}, TOP, {}).units["dsp"]
    variance = math.log(1 + 0.3**2)
    median = 4.0 / math.exp(variance / 2)
    ends = [median * math.exp(sign * 1.2816 * math.sqrt(variance)) for sign in (-1, 1)]
    assert [found.low_w, found.high_w] == pytest.approx(ends)


def test_the_busy_share_of_a_held_rate_is_as_uncertain_as_the_time() -> None:
    """Half of the time at 4 W instead of 0.5 W: 10 % more time is 0.175 W more. Who always works has no such error."""
    for busy, deviation in ((0.5, 0.5 * 0.1 * 3.5), (1.0, 0.0)):
        found = device_power(chip(), {"cpu": 0.0, "gpu": 0.0, "dsp": busy}, TOP, {"dsp": 0.1}).units["dsp"]
        variance = math.log(1 + (deviation / found.w) ** 2)
        assert found.high_w / found.low_w == pytest.approx(math.exp(2 * 1.2816 * math.sqrt(variance)))


@pytest.mark.parametrize(
    ("times", "holds", "words"),
    [
        ((20.0, 15.0, 30.0), True, "holds, and would at the slow end of the interval"),
        ((30.0, 20.0, 50.0), True, "holds, but not at the slow end of the interval"),
        ((50.0, 30.0, 60.0), False, "does not hold, but would at the fast end of the interval"),
        ((60.0, 50.0, 70.0), False, "does not hold, nor would it at the fast end of the interval"),
    ],
)
def test_whether_a_rate_holds(times: tuple[float, float, float], holds: bool, words: str) -> None:
    """At 25 frames a second, a frame has 40 ms."""
    found = holding(25.0, FrameInterval(*times))
    assert (found.holds, found.words, found.fps) == (holds, words, 25.0)
    reserves = [found.reserve, found.reserve_high, found.reserve_low]
    assert reserves == pytest.approx([1 - ms / 40 for ms in times])


def on_dsp(ms: float) -> FrameLoad:
    """A network of `ms` at the highest clock, half as fast at each lower corner."""

    def work_ms(corners: Corners) -> Mapping[UnitName, float]:
        return {"dsp": ms * 2 ** CORNERS.index(corners[2])}

    return FrameLoad(work_ms, lambda corners: work_ms(corners)["dsp"])


@pytest.mark.parametrize(
    ("limit", "fps", "corner", "by"),
    [
        (2.5, 0.0, "max", "power"),  # idle units and base take all of it
        (6.5, 100.0, "max", "speed"),  # 4 W at work, 1 W of idle units, 1 W of base
        (9.0, 100.0, "max", "speed"),
        # At max (5 - 2.5) W over 3.5 W * 10 ms: 71.4; at turbo 0.5 W over 0.5 W * 20 ms, which speed bounds at 50.
        (5.0, 2.5 / 0.035, "max", "power"),
        # 0.3 W: at max 0.3 / 0.035 = 8.6; at turbo 0.3 / (0.5 * 0.02) = 30; one corner lower, speed bounds at 25.
        (2.8, 30.0, "turbo", "power"),
    ],
)
def test_the_rate_within_a_power(limit: float, fps: float, corner: str, by: str) -> None:
    found = within_power(chip(), TOP, on_dsp(10.0), limit)
    assert found.fps == pytest.approx(fps, rel=1e-9)
    assert (found.limited_by, found.idle_w) == (by, 2.5)
    assert found.power_w <= limit + 1e-9 or not fps
    assert found.corners == {"dsp": corner}


def test_only_corners_that_may_be_the_best_are_simulated() -> None:
    """At the highest clock 100 a second are within the power; no lower one can pass that."""
    load, asked = on_dsp(10.0), list[Corners]()
    told = FrameLoad(load.work_ms, lambda corners: asked.append(corners) or load.frame_ms(corners))
    assert within_power(chip(), TOP, told, 9.0).fps == 100.0
    assert set(asked) == {TOP}


def test_the_rate_within_a_power_is_as_uncertain_as_the_power() -> None:
    """The rate within the limit that would be kept if the device took what the ends of its interval say."""
    profile, load = chip(0.3), on_dsp(10.0)
    found = within_power(profile, TOP, load, 5.0)
    power = device_power(profile, {"cpu": 0.0, "gpu": 0.0, "dsp": found.fps / 100}, TOP, {})
    assert power.w == pytest.approx(5.0) == found.power_w
    for key, end in (("low_fps", "high_w"), ("high_fps", "low_w")):
        limit = within_power(profile, TOP, load, 5.0 * 5.0 / getattr(power, end))
        assert getattr(found, key) == pytest.approx(limit.fps)
    assert found.low_fps < found.fps < found.high_fps
    sure = within_power(chip(), TOP, load, 5.0)
    assert sure.low_fps == pytest.approx(sure.fps) == pytest.approx(sure.high_fps)


def test_the_rate_within_a_power_is_the_best_of_all_corners() -> None:
    """By trying every rate of every choice of corners, for work on two units that follow each other."""
    profile, limit = load_profile("snapdragon-888"), 3.3
    requested = corners_of(profile, "burst")

    def work_ms(corners: Corners) -> dict[UnitName, float]:
        return {u: 8.0 / profile.units[u].clock(corners[UNITS.index(u)]) for u in ("gpu", "dsp")}

    best = 0.0
    for gpu, dsp in product(CORNERS, CORNERS):
        corners: Corners = (requested[0], gpu, dsp)
        work = work_ms(corners)
        for fps in range(1, 70):
            busy = {"cpu": 0.0, **{unit: ms * fps / 1e3 for unit, ms in work.items()}}
            watts = sum(profile.units[u].power_w(c, busy[u]) for u, c in zip(UNITS, corners, strict=True))
            if sum(work.values()) * fps <= 1e3 and watts + profile.thermal.base_power_w.or_else(0) <= limit:
                best = max(best, fps)
    found = within_power(profile, requested, FrameLoad(work_ms, lambda c: sum(work_ms(c).values())), limit)
    assert best == int(found.fps)


def test_only_what_is_wanted_is_answered() -> None:
    times = FrameInterval(10.0, 9.0, 11.0)
    assert answers(chip(), on_dsp(10.0), TOP, Wanted(), times) == {}
    found = answers(chip(), on_dsp(10.0), TOP, Wanted(30.0, 6.0), times)
    assert (found["rate"].fps, found["power_limit"].limit_w) == (30.0, 6.0)


def test_operators_and_what_has_no_rule() -> None:
    operators = tuple(
        Operator(name, kind, "elementwise", macs, moved, 0, 0, 0, 1, ruled=ruled)
        for name, kind, macs, moved, ruled in (
            ("a", "Conv", 7, 50, True),
            ("b", "Odd", 0, 10, False),
            ("c", "Odd", 0, 20, False),
            ("d", "Warp", 0, 120, False),
        )
    )
    work = Work(operators, 1, 1, 1)
    times = tuple(OperatorTime(o.name, o.op_type, 1.0 + n, "fixed") for n, o in enumerate(operators))
    rows = operator_rows(work, NetworkTime("dsp", 2.0, times))
    assert rows[0].as_json() == {
        **{"name": "a", "op_type": "Conv", "ms": 1.0, "share": 1 / 12, "bound": "fixed", "macs": 7, "elements": 50}
    }
    assert [row.ms for row in rows] == [1, 2, 3, 4]
    assert [row.as_json() for row in without_rule(work)] == [
        {"op_type": "Warp", "count": 1, "share_of_elements": 0.6},
        {"op_type": "Odd", "count": 2, "share_of_elements": 0.15},
    ]


@pytest.mark.parametrize(
    ("unit", "numbers", "asked", "precision"),
    [
        ("dsp", "w8a8", None, "int8"),
        ("dsp", "not said", None, "int8"),
        ("dsp", "float", None, "fp16"),
        ("dsp", "float", "int8", "int8"),
        ("gpu", "w8a8", None, "fp16"),
        ("gpu", "float", None, "fp16"),
        ("gpu", "not said", "fp32", "fp32"),
    ],
)
def test_precision(unit: UnitName, numbers: Any, asked: str | None, precision: str) -> None:
    found = in_precision(load_profile("snapdragon-888"), unit, numbers, asked)
    assert found.units[unit].precision == precision
    assert found.units["cpu"] == load_profile("snapdragon-888").units["cpu"]


def test_the_runtime_of_an_engine(tmp_path: Path) -> None:
    """Both runtimes have numbers of their own; None is the profile's; who has no engine is told."""
    graph, profile = graph_of(tmp_path), load_profile("snapdragon-8-gen-3")
    under = {name: under_runtime(profile, "dsp", name) for name in ENGINE_RUNTIMES}
    usual, other = (predict_network(under[name], graph, "dsp") for name in ("tflite", "qnn_dlc"))
    assert (usual.engine_runtime, other.engine_runtime) == ("tflite", "qnn_dlc")
    assert usual.network_ms != other.network_ms
    assert under_runtime(profile, "dsp", None) is profile
    assert under_runtime(profile, "dsp", "qnn_dlc").units["gpu"] == profile.units["gpu"]
    assert predict_network(profile, graph, "gpu").engine_runtime is None
    for unit, precision in (("gpu", "fp16"), ("dsp", "fp32")):
        told = (
            f"found tflite for the {unit} .* in {precision}, expected tflite or qnn_dlc for the dsp in int8 or fp16; "
        )
        with pytest.raises(BadInputError, match=told):
            under_runtime(in_precision(profile, unit, "not said", precision), unit, "tflite")  # type: ignore[arg-type]
    with pytest.raises(BadInputError, match="expected a chip with a tensor engine"):
        under_runtime(load_profile("agx-orin"), "gpu", "tflite")


def image_graph(shape: tuple[int, ...]) -> onnx.ModelProto:
    """A convolution of three channels to four where these come first, else a hyperbolic tangent."""
    ends = [
        helper.make_tensor_value_info(n, TensorProto.FLOAT, s)
        for n, s in (("image", shape), ("w0", (4, 3, 3, 3)), ("y", None))
    ]
    convolved = len(shape) == 4 and shape[1] == 3
    node = (
        helper.make_node("Conv", ["image", "w0"], ["y"], pads=[1] * 4)
        if convolved
        else helper.make_node("Tanh", ["image"], ["y"])
    )
    graph = helper.make_graph([node], "g", ends[: 1 + convolved], ends[2:])
    return helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)])


def graph_of(folder: Path, shape: tuple[int, ...] = (1, 3, 64, 32)) -> Any:
    path = folder / "net.onnx"
    path.write_bytes(image_graph(shape).SerializeToString())
    return read_graph(path)


@pytest.mark.parametrize("unit", UNITS)
def test_everything_about_one_network(unit: UnitName, tmp_path: Path) -> None:
    graph, profile = graph_of(tmp_path), load_profile("snapdragon-888")
    found = predict_network(profile, graph, unit, "burst")
    work, corners = count_work(graph.model), corners_of(profile, "burst")
    time = price(profile, work, unit, corners)
    around = interval(profile, work, time)
    assert (found.network_ms, found.low_ms, found.high_ms) == (time.total_ms, *around[:2])
    assert found.job_ms + sum(row.ms for row in found.operators) == pytest.approx(found.network_ms)
    assert found.gmac == work.macs / 1e9 == 64 * 32 * 27 * 4 / 1e9
    assert found.parameters_m == 27 * 4 / 1e6
    busy = {each: float(each == unit) for each in UNITS}
    assert found.power == device_power(profile, busy, corners, {unit: spread_of(around)})
    assert found.rate is None and not found.timeline


def test_a_network_at_a_rate_is_busy_for_its_share(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A network of 8 ms 25 times a second works a fifth of the time; of 50 ms, always."""
    for ms, share in ((8.0, 0.2), (50.0, 1.0)):
        time = NetworkTime("dsp", 0.0, (OperatorTime("", "Conv", ms, "fixed"),))
        monkeypatch.setattr(network_time, "price", lambda *_, time=time: time)
        monkeypatch.setattr(network_time, "interval", lambda *_, ms=ms: Interval(ms / 2, 2 * ms, ()))
        found = predict_network(chip(), graph_of(tmp_path), "dsp", wanted=Wanted(25.0))
        corner = corners_of(chip(), "burst")[2]
        assert found.power.units["dsp"].w == pytest.approx(chip().units["dsp"].power_w(corner, share))
        assert found.rate.reserve == pytest.approx(1 - ms / 40)
        assert found.rate.reserve_low == pytest.approx(1 - 2 * ms / 40)


def test_over_minutes_a_slow_rate_heats_less_than_full_speed(tmp_path: Path) -> None:
    graph, profile = graph_of(tmp_path, (1, 3, 1024, 1024)), load_profile("snapdragon-888")
    full, slow = (predict_network(profile, graph, "dsp", "burst", 2.0, None, Wanted(fps)) for fps in (None, 5.0))
    assert slow.temperature_c.device_end < full.temperature_c.device_end
    assert slow.fps_settled == slow.fps_start == pytest.approx(5.0)
    assert full.fps_start > 5.0 and len(full.timeline) > 10


@pytest.mark.parametrize("shape", [(1, 3, 64, 32), (1, 64, 32, 3)])
def test_a_picture_in_either_order(shape: tuple[int, ...], tmp_path: Path) -> None:
    network = image_network(graph_of(tmp_path, shape), "packed")
    assert (network.height, network.width, network.channels, network.layout) == (64, 32, 3, "packed")
    assert network.facts == {"network": str(tmp_path / "net.onnx")}


@pytest.mark.parametrize("shape", [(2, 3, 64, 32), (1, 100, 90, 80), (1, 3, 64)])
def test_what_is_no_picture_cannot_be_the_applications(shape: tuple[int, ...], tmp_path: Path) -> None:
    with pytest.raises(BadInputError, match=f"inputs {'x'.join(map(str, shape))}, expected one picture"):
        image_network(graph_of(tmp_path, shape), "packed")


def test_a_convolution_of_vectors_is_refused() -> None:
    nodes = [helper.make_node("Conv", ["a", "b"], ["c"]), helper.make_node("Relu", ["c"], ["d"])]
    a, b, c, d = (helper.make_tensor_value_info(name, TensorProto.FLOAT, [4]) for name in "abcd")
    graph = helper.make_graph(nodes, "g", [a, b], [d], value_info=[c])
    with pytest.raises(BadInputError, match="convolution of pictures"):
        count_work(helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)]))


def test_shapes_that_contradict_each_other_are_refused() -> None:
    """A number has the name of the result."""
    model = net()
    model.graph.initializer[0].name = "rgba"
    with pytest.raises(BadInputError, match="shapes that follow from each other"):
        count_work(model)
