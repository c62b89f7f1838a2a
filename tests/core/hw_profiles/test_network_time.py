"""A network's time by operator: the parts are the whole, what bounds each, and the interval around it, by hand."""

from __future__ import annotations

import math
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from trilane.hw_profiles.application import isolated_job_time
from trilane.hw_profiles.governor import caps_of, ends_of, settled_corners, temperatures_of, timeline_of
from trilane.hw_profiles.network_time import Interval, NetworkTime, OperatorTime, interval, price, spread_of
from trilane.hw_profiles.network_work import Operator, Work
from trilane.hw_profiles.operators import NAMES, EngineLayer, Layers
from trilane.hw_profiles.prediction import Throttling
from trilane.hw_profiles.profile_files import load_profile
from trilane.hw_profiles.reference_networks import NetworkSpec, reference_network
from trilane.hw_profiles.schema import Profile, Quantity, corners_of
from trilane.hw_profiles.unit_times import layer_times, relative_error, stated_error, time_on, unsure

CHIP = load_profile("snapdragon-888")
TOP = corners_of(CHIP, "burst")


@pytest.mark.parametrize("unit", ["gpu", "dsp"])
def test_the_operators_and_the_job_are_the_whole_time(unit: str) -> None:
    network, corners = reference_network(NetworkSpec("resnet18", "group", 256, 256, 16)), TOP
    time = price(CHIP, network.work, unit, corners)  # type: ignore[arg-type]
    assert time.total_ms == pytest.approx(isolated_job_time(CHIP, network, unit, corners).total_ms)  # type: ignore[arg-type]
    named = network.work.layers.layers if unit == "dsp" else network.work.operators
    assert [o.name for o in time.operators] == [o.name for o in named]
    around = interval(CHIP, network.work, time)
    assert around.low_ms < time.total_ms < around.high_ms
    assert around.why


def number(value: float, spread: float = 0.0) -> Quantity:
    return Quantity(value=value, kind="assumed", source="by hand", spread=spread)


def gpu_chip() -> Profile:
    """A GPU of 1 TMAC/s and a memory of 10 GB/s, all of which is reached; 3 ms a job, 100 us an operator; 2 bytes."""
    own = CHIP.units["gpu"]
    efficiency = own.efficiency.model_copy(update={key: number(1.0) for key in type(own.efficiency).model_fields})
    told = {"job_fixed_ms": 3.0, "operator_fixed_us": 100.0, "input_ns_per_element": 0.0, "peak_fp16_tmac_s": 1.0}
    numbers = {key: number(value) for key, value in told.items()} | {"channel_block": number(1.0)}
    unit = own.model_copy(update={"efficiency": efficiency, "precision": "fp16", **numbers})
    memory = CHIP.memory.model_copy(update={"bandwidth_gb_s": number(10.0)})
    return CHIP.model_copy(update={"units": {**CHIP.units, "gpu": unit}, "memory": memory})


def operator(name: str, kind: str, macs: int, moved: int, weights: int, channels: int = 1) -> Operator:
    return Operator(name, f"of {name}", kind, macs, moved, weights, channels, channels, 1)


@pytest.mark.parametrize(
    ("one", "ms", "bound"),
    [
        (operator("a", "convolution", 2 * 10**9, 10**6, 10**6), 0.1 + 0.2 + 2.0, "arithmetic"),
        (operator("b", "convolution", 10**9, 10**7, 10**6), 0.1 + 0.2 + 2.0, "activation traffic"),  # 1 ms of products
        (operator("c", "convolution", 11 * 10**8, 10**7, 10**6), 0.1 + 0.2 + 2.0, "arithmetic"),  # more than half of it
        (operator("d", "elementwise", 0, 10**6, 0), 0.1 + 0.2, "activation traffic"),
        (operator("e", "elementwise", 0, 10**5, 0), 0.1 + 0.02, "fixed"),
        (operator("f", "convolution", 10**8, 10**5, 10**7), 0.1 + 2.0 + 0.1, "weight traffic"),
    ],
)
def test_what_bounds_an_operator_by_the_roofline(one: Operator, ms: float, bound: str) -> None:
    """Bytes are 0.2 ns each; the operator's fixed time is its own, that of the job is not."""
    chip = gpu_chip()
    found = price(chip, Work((one,), 0, 1, 1), "gpu", TOP)
    assert found.operators == (OperatorTime(one.name, one.op_type, pytest.approx(ms, rel=1e-9), bound),)  # type: ignore[arg-type]
    assert found.job_ms == pytest.approx(3.0)
    assert NetworkTime("gpu", 3.0, found.operators * 2).total_ms == pytest.approx(3.0 + 2 * ms)


@pytest.mark.parametrize(
    ("term", "bound"),
    [
        ("convolution", "arithmetic"),
        ("moved", "activation traffic"),
        ("weights", "weight traffic"),
        ("operator", "fixed"),
    ],
)
def test_what_bounds_a_layer_of_an_engine(term: str, bound: str) -> None:
    amounts = {term: 1e6}
    layers = Layers((EngineLayer("l", "Conv", amounts, ("x",), "y"),), {"x": 1, "y": 1}, 1, 1)
    work = Work((), 1, 1, 1, layers)
    ((layer,), found) = price(CHIP, work, "dsp", TOP).operators, time_on(CHIP.units["dsp"], CHIP.memory, work)
    assert (layer.name, layer.op_type, layer.bound) == ("l", "Conv", bound)
    engine = CHIP.units["dsp"].engine
    assert engine is not None and found.unsure is not None
    seconds = engine.seconds_per_unit(
        {"convolution": "arithmetic", "moved": "activation", "weights": "weight"}.get(term, term)
    )
    assert layer.ms == pytest.approx(1e3 * 1e6 * seconds, rel=1e-3)


def test_what_an_engine_hands_to_the_processor() -> None:
    """Two operators of 500 and 700 results, in batches of three: fixed times once, elements three times.

    Their layers take nothing on the engine. The input comes in two tensors, and has 40 elements.
    """
    own = CHIP.units["dsp"]
    told = {"fallback_fixed_ms": 2.0, "fallback_ns_per_element": 1e3, "permute_fixed_ms": 7.0}
    told |= {"input_ns_per_element": 1e4}
    unit = own.model_copy(update={"fallback": ("Odd",), **{key: number(value) for key, value in told.items()}})
    layers = tuple(EngineLayer(name, kind, {"operator": 1}, (), name) for name, kind in (("a", "Odd"), ("b", "Conv")))
    operators = tuple(
        Operator("", kind, "elementwise", 0, 0, 0, 0, 0, out) for kind, out in (("Odd", 500), ("Odd", 700), ("Conv", 9))
    )
    work = Work(operators, 40, 2, 1, Layers(layers, {"a": 1, "b": 1}, 0, 0))
    found = time_on(unit, CHIP.memory, work, batch=3).parts
    assert unit.engine is not None
    cost = unit.engine.seconds_per_unit("operator")
    assert found["fallback"] == pytest.approx(2 * 2.0 + 3 * 1200 * 1e-3)
    assert found["fixed"] == pytest.approx(1e3 * cost + 7.0)
    bare = time_on(own, CHIP.memory, Work((), 0, 1, 1, Layers((), {}, 0, 0))).parts
    assert found["input"] == pytest.approx(bare["input"] + 3 * 40 * 1e4 / 1e6)
    assert bare["fixed"] == bare["fallback"] == 0
    seconds = layer_times(unit, CHIP.memory, work, batch=3).layers
    assert seconds[0].sum() == 0 and seconds[1].sum() == pytest.approx(cost, rel=1e-3)


def test_the_error_of_a_job_on_an_engine_joins_those_of_its_terms() -> None:
    """Of two halves, each of another rate: half of each rate's spread and of each factor's, as independent ones."""
    engine = CHIP.units["dsp"].engine
    assert engine is not None
    changed = engine.rates.model_copy(
        update={
            "activation_gb_s": number(1.0, 0.3),
            "operator_us": number(1.0, 0.4),
            "arithmetic_tmac_s": number(1.0, 5.0),
        }
    )
    told = engine.model_copy(update={"rates": changed, "factors": {"pool": number(1.0, 0.8)}})
    shares = np.array([0.5 if name in ("pool", "operator") else 0.0 for name in NAMES])
    assert unsure(told, shares) == pytest.approx(math.hypot(0.5 * 0.3, 0.5 * 0.4, 0.5 * 0.8))


def test_the_interval_and_why_by_hand() -> None:
    """80 % of a normal distribution of the logarithm lie within 1.2816 of its standard deviations."""
    work = Work((operator("a", "convolution", 10**9, 10**6, 10**6), operator("b", "elementwise", 0, 9, 0)), 0, 1, 1)
    odd = work.operators[1]._replace(ruled=False, op_type="Warp")
    work = Work((*work.operators, odd, odd._replace(op_type="Odd"), odd), 0, 1, 1)
    chip = gpu_chip()
    time = NetworkTime("gpu", 8.0, ())
    found = interval(chip, work, time)
    spread = spread_of(found)
    assert math.sqrt(found.low_ms * found.high_ms) == pytest.approx(8.0)
    assert found.high_ms / 8.0 == pytest.approx(math.exp(1.2816 * spread))
    assert found.why == (
        f"the profile states a relative error of {spread:.0%} for networks on its gpu",
        "no rule for Odd, Warp: counted as the movement of its elements",
    )
    assert spread_of(Interval(1.0, math.exp(2 * 1.2816), ())) == pytest.approx(1.0)


def test_the_interval_on_an_engine_names_what_is_ill_known() -> None:
    """Of a job of pooling alone, whose factor is known to 40 % and its rate to 30: 50 % together. The only network of
    the fit had half of its time in it: half of 12 % besides.
    """
    own = CHIP.units["dsp"]
    assert own.engine is not None
    changed = own.engine.rates.model_copy(
        update={key: number(getattr(own.engine.rates, key).value, 0.3) for key in type(own.engine.rates).model_fields}
    )
    factors = {"pool": number(1.0, 0.4), "input": number(1.0, 0.4), "leaky": number(1.0, 0.9)}
    update = {"rates": changed, "error_fraction": number(0.12), "factors": factors}
    update["seen"] = {"half": {"pool": 0.5, "convolution": 0.5}}
    name = own.engine_runtime
    engines = {key: each.model_copy(update=update) for key, each in own.engines.items()}
    unit = own.model_copy(update={"engines": engines})
    chip = CHIP.model_copy(update={"units": {**CHIP.units, "dsp": unit}})
    assert unit.engine is not None and name
    layers = Layers((EngineLayer("l", "MaxPool", {"pool": 1e12}, ("x",), "y"),), {"x": 1, "y": 1}, 1, 1)
    work = Work((), 1, 1, 1, layers)
    found = interval(chip, work, price(chip, work, "dsp", TOP))
    assert spread_of(found) == pytest.approx(math.hypot(0.3, 0.4, 0.06), rel=1e-4)
    assert found.why == (
        "networks as unlike those of the fit were off by 6% besides what its numbers leave open",
        "of those half is most like it; 50% of the time goes into other work",
        "the numbers leave 50% open for this one",
        "100% of it is pool, known to 40%",
    )


def test_an_engine_whose_error_is_unknown_is_off_by_half() -> None:
    own = CHIP.units["dsp"]
    unknown = Quantity(kind="unknown", source="by hand")
    engines = {
        key: each.model_copy(update={"error_fraction": unknown, "seen": {}}) for key, each in own.engines.items()
    }
    chip = CHIP.model_copy(update={"units": {**CHIP.units, "dsp": own.model_copy(update={"engines": engines})}})
    work = reference_network(NetworkSpec("resnet18", "batch", 64, 64, 8)).work
    time = price(chip, work, "dsp", TOP)
    found = interval(chip, work, time)
    assert found.why[:2] == (
        "networks as unlike those of the fit were off by 50% besides what its numbers leave open",
        "its profile names no network that its numbers were fitted to",
    )
    left = time_on(chip.units["dsp"], chip.memory, work).unsure or 0.0
    assert spread_of(found) == pytest.approx(math.hypot(0.5, left), rel=1e-6)


def moment(t_s: int, corner: str, **told: float) -> Any:
    defaults = {"frame_ms": 20.0, "device_c": 30.0 + t_s, "junction_c": 50.0 - t_s, "power_w": 2.0}
    return SimpleNamespace(t_s=t_s, corners=("max", corner, "max"), throttled=3 <= t_s < 5, **(defaults | told))


def test_what_is_said_of_minutes() -> None:
    """Ten moments; the last fifth are two, of 20 and 30 ms."""
    moments = [moment(t_s, "max" if t_s < 7 else "turbo") for t_s in range(9)] + [moment(9, "max", frame_ms=30.0)]
    assert ends_of(moments) == {"fps_start": 50.0, "fps_settled": 40.0}
    assert ends_of(moments[:3]) == {"fps_start": 50.0, "fps_settled": 50.0}
    assert settled_corners(moments) == ("max", "turbo", "max")  # as often as the other one, and before it
    assert settled_corners([*moments, *moments[-1:] * 5]) == ("max", "max", "max")
    assert temperatures_of(moments).as_json() == {"device_end": 39.0, "device_max": 39.0, "junction_max": 50.0}
    assert temperatures_of(moments[::-1]).device_end == 30.0
    assert temperatures_of([]).as_json() == {}
    assert caps_of(moments).as_json() == {"throttled_share": 0.2, "first_throttled_s": 3}
    assert caps_of([]) == caps_of(moments[:2]) == Throttling(throttled_share=0.0, first_throttled_s=None)
    assert timeline_of(moments)[7] == {
        **{"t_s": 7, "fps": 50.0, "device_c": 37.0, "junction_c": 43.0, "power_w": 2.0},
        "corners": {"cpu": "max", "gpu": "turbo", "dsp": "max"},
    }
    assert [row["t_s"] for row in timeline_of([moment(t_s, "max") for t_s in range(1081)])] == list(range(0, 1081, 4))
    assert [len(timeline_of([moment(t_s, "max") for t_s in range(count)])) for count in (360, 719)] == [360, 360]


def test_a_precision_whose_speed_nobody_states_is_said_and_less_certain() -> None:
    """Of FP32 on the 888's DSP nothing is known but its work; what is unknown is known to a factor e."""
    work = reference_network(NetworkSpec("resnet18", "batch", 64, 64, 16)).work
    dsp = CHIP.units["dsp"].model_copy(update={"precision": "fp32"})
    profile = CHIP.model_copy(update={"units": {**CHIP.units, "dsp": dsp}})
    around = interval(profile, work, price(profile, work, "dsp", TOP))
    assert around.why[-1] == "it does not know how fast its dsp is in fp32: 0.1 TMAC/s are assumed"
    job = time_on(dsp, profile.memory, work)
    stated = stated_error(job, dsp)
    assert spread_of(around) == pytest.approx(relative_error(job, dsp)) == pytest.approx(math.hypot(stated, 1.0))
    known = CHIP.units["dsp"]
    assert relative_error(job, known) == stated_error(job, known)
