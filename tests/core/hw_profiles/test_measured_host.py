"""What was measured of this machine, in its profile and in what is predicted by it: by hand, with told times."""

from __future__ import annotations

import math
from statistics import fmean
from typing import Any

import pytest

from trilane.hw_profiles.application import Plan, Variant, stage_times_ms
from trilane.hw_profiles.graph_file import GraphFile
from trilane.hw_profiles.host_model import (
    MODEL_ERROR,
    UNMEASURED,
    error_of,
    place_units,
    with_network,
    with_stages,
    with_threads,
)
from trilane.hw_profiles.network_time import predict_network, price
from trilane.hw_profiles.predict import predict, predict_table, what_if
from trilane.hw_profiles.profile_files import load_profile
from trilane.hw_profiles.rates import Wanted
from trilane.hw_profiles.reference_networks import ConfigurationRow, NetworkSpec, reference_network
from trilane.hw_profiles.schema import Profile, corners_of
from trilane.hw_profiles.unit_times import time_on
from trilane.scheduler.placement import CpuCore
from trilane.units import BURST

NETWORK = reference_network(NetworkSpec("resnet18", "batch", 64, 96, 10))
LARGER = reference_network(NetworkSpec("resnet18", "batch", 128, 96, 10))
#: ns of each stage in three frames; the median counts.
TOOK_NS = {
    "pose": [900_000, 1_000_000, 5_000_000],
    "raster": [3_000_000, 2_000_000, 1_000_000],
    "infer": [7_000_000, 6_000_000, 6_500_000],
    "composite": [4_000_000, 4_000_000, 4_000_000],
    "present": [1_900_000, 2_000_000, 2_100_000],
}
PIPELINED = Variant("pipelined", "double")
SAID = "measured here"


@pytest.fixture(autouse=True)
def four_cores(monkeypatch: pytest.MonkeyPatch) -> None:
    for module in ("host", "predict"):
        monkeypatch.setattr(f"trilane.hw_profiles.{module}.usable_cores", lambda: (0, 1, 2, 3))


def measured(error: float = 0.1, **ms: float) -> Profile:
    """This machine with a network that took so long, by threads (`t1`, `t2`), and with stages."""
    took = {int(threads[1:]): each for threads, each in (ms or {"t1": 6.5, "t2": 4.0}).items()}
    return with_stages(
        with_network(load_profile("host"), NETWORK.work, took, error, SAID), NETWORK, TOOK_NS, "by a test"
    )


@pytest.mark.parametrize(("threads", "ms"), [(1, 6.5), (2, 4.0), (4, 4.5)])
def test_a_network_takes_what_was_measured_with_each_number_of_threads(threads: int, ms: float) -> None:
    """The rest of the application, too, was there when it was measured, and slows it no further."""
    profile = measured(t1=6.5, t2=4.0, t4=4.5)
    unit = with_threads(profile.units["dsp"], threads)
    for contended in (False, True):
        assert time_on(unit, profile.memory, NETWORK.work, contended=contended).total_ms == pytest.approx(ms)
    units = {**profile.units, "dsp": unit}
    time = price(profile.model_copy(update={"units": units}), NETWORK.work, "dsp", corners_of(profile, BURST))
    assert time.total_ms == pytest.approx(ms) and sum(each.ms for each in time.operators) < time.total_ms


def test_another_shape_takes_in_proportion_to_its_modelled_time() -> None:
    """The unit has two threads of four cores: what 4 ms are over what is modelled of the one, it is for the other."""
    plain, found = load_profile("host").units["dsp"], measured()
    memory = found.memory
    own, larger = (time_on(plain, memory, each.work).total_ms for each in (NETWORK, LARGER))
    assert larger > 1.5 * own
    took = time_on(found.units["dsp"], memory, LARGER.work).total_ms
    assert took == pytest.approx(4.0 * larger / own)


def test_stages_have_their_medians_and_the_scheduler_its_part() -> None:
    """0.1 ms for each of five jobs, half with pose, half with present."""
    profile = measured()
    found = stage_times_ms(profile, Plan(NETWORK, "dsp"), corners_of(profile, BURST))
    assert {name: ms for (name, _), ms in found.items()} == pytest.approx(
        {"pose": 1.25, "raster": 2.0, "infer": 4.0, "composite": 4.0, "present": 2.25}
    )
    host = with_network(load_profile("host"), NETWORK.work, {1: 6.5}, 0.1, SAID)
    two = with_stages(host, NETWORK, TOOK_NS, "by a test", avatars=2)
    found = stage_times_ms(two, Plan(NETWORK, "dsp", avatars=2), corners_of(profile, BURST))
    assert found["pose", "cpu"] == pytest.approx(1.25), "the poses of both avatars were measured"
    larger = stage_times_ms(profile, Plan(LARGER, "dsp"), corners_of(profile, BURST))
    assert larger["raster", "gpu"] == pytest.approx(4.0), "twice the pixels"


def test_the_error_is_that_of_the_model_and_the_scatter_of_what_was_measured() -> None:
    """The model's own is at least what `bench placement` found in ten scenes and sizes: predicted over measured of the
    chosen placement (docs/decisions/placement.md), whose root mean square of logarithms is 0.10."""
    ratios = (1.13, 1.18, 1.09, 1.09, 1.06, 1.13, 1.15, 1.06, 1.12, 1.04)
    assert math.sqrt(fmean(math.log(ratio) ** 2 for ratio in ratios)) == pytest.approx(MODEL_ERROR, abs=0.01)
    assert error_of([5.0]) == MODEL_ERROR
    assert error_of([7.0, 7.0, 7.0]) == pytest.approx(MODEL_ERROR)
    assert error_of([math.exp(0.0), math.exp(0.1), math.exp(0.2)]) == pytest.approx(math.hypot(0.1, MODEL_ERROR))


def test_a_prediction_of_what_was_measured_has_its_interval() -> None:
    """80 % of a normal distribution are within 1.2816 deviations; of an error of 0.1, a factor of exp(0.12816)."""
    answer = predict(measured(error=0.1, t1=6.5, t2=6.4), Plan(NETWORK, "dsp", PIPELINED), BURST)
    frame, network, factor = answer.frame_time_ms, answer.network, math.exp(0.12816)
    assert (network.low_ms, network.high_ms) == pytest.approx((network.alone_ms / factor, network.alone_ms * factor))
    assert frame.mean == pytest.approx(network.alone_ms, rel=0.02), "the slowest unit"
    assert (frame.low, frame.high) == pytest.approx((frame.mean / factor, frame.mean * factor))
    assert (answer.expected_error, answer.confidence) == pytest.approx((0.1, 0.9))
    assert network.why == (SAID,) and any(SAID in note for note in answer.notes)
    assert answer.power.low_w is answer.power.units["gpu"].high_w is None, "no power is measured"


def test_a_frame_that_the_network_does_not_bound_has_an_interval_too() -> None:
    """The GPU's unit, with 6 ms of raster and composite, was measured as well as the network."""
    answer = predict(measured(error=0.1, t1=1.0, t2=1.0), Plan(NETWORK, "dsp", PIPELINED), BURST)
    frame = answer.frame_time_ms
    assert frame.mean == pytest.approx(6.0, rel=0.02)
    assert frame.high / frame.mean == pytest.approx(math.exp(0.12816))


def test_a_display_bounds_the_interval() -> None:
    """At a period of 6.5 ms, frames of 6 ms are held; at the slow end, of 6.8 ms, they are not."""
    profile, plan = measured(error=0.1, t1=1.0, t2=1.0), Plan(NETWORK, "dsp", PIPELINED)
    answer = predict(profile, plan, BURST, wanted=Wanted(1e3 / 6.5))
    frame = answer.frame_time_ms
    assert (frame.mean, frame.low) == pytest.approx((6.5, 6.5), rel=0.01)
    assert frame.high == pytest.approx(6.0 * math.exp(0.12816), rel=0.02)


@pytest.mark.parametrize("runtime", ["dsp", "gpu"])
def test_what_was_not_measured_has_no_interval(runtime: Any) -> None:
    """Neither of times nor of powers, and no confidence; the words of a rate say whether it holds and no more."""
    host = load_profile("host") if runtime == "dsp" else measured()
    answer = predict(host, Plan(NETWORK, runtime, PIPELINED), BURST, wanted=Wanted(1.0))
    assert answer.frame[1:] == (None, None)
    assert (answer.network.low_ms, answer.network.high_ms) == (None, None)
    assert answer.expected_error is answer.confidence is None
    rate = answer.rate
    assert (rate.words, rate.reserve_low, rate.reserve_high) == ("holds", None, None)
    assert UNMEASURED in answer.notes
    chip = predict(load_profile("snapdragon-888"), Plan(NETWORK, runtime, PIPELINED), BURST, wanted=Wanted(1.0))
    assert "slow end" in chip.rate.words and chip.power.low_w > 0 and chip.confidence > 0


def test_a_network_by_itself_has_its_measured_time_or_no_interval() -> None:
    graph: Any = GraphFile("net.onnx", None, "w8a8", NETWORK.work)  # type: ignore[arg-type]
    answer = predict_network(measured(error=0.1, t1=6.5), graph, "dsp")
    assert answer.network_ms == pytest.approx(6.5) and answer.why == (SAID,)
    assert answer.low_ms == pytest.approx(6.5 / math.exp(0.12816))
    assert sum(row.share for row in answer.operators) == pytest.approx(1 - answer.job_ms / 6.5)
    plain = predict_network(load_profile("host"), graph, "dsp", wanted=Wanted(1.0, 900.0))
    limit = plain.power_limit
    assert limit.low_fps is limit.high_fps is None and limit.fps > 0 and plain.rate.words == "holds"
    assert plain.low_ms is plain.high_ms is None and plain.why == (UNMEASURED,)
    on_gpu = predict_network(measured(), graph, "gpu")
    assert on_gpu.low_ms is None and on_gpu.why == (UNMEASURED,), "only the unit for networks is measured"


def test_units_are_placed_by_the_measured_times() -> None:
    """Two threads that are slower than one are not taken, and a number that was not measured is none to choose from."""
    cores, plan = [CpuCore(number, number) for number in range(4)], Plan(NETWORK, "dsp", PIPELINED)

    def threads(**ms: float) -> set[int]:
        profile = measured(**ms)
        found = place_units(profile, plan, corners_of(profile, BURST), cores).found
        assert {each.placement["dsp"].threads for each in found} <= {int(name[1:]) for name in ms}
        return {found[0].placement["dsp"].threads}

    assert threads(t1=20.0, t2=11.0) == {2}
    assert threads(t1=20.0, t2=21.0) == {1}
    assert threads(t2=20.0, t4=21.0) == {2}


def test_alternatives_and_longer_times_are_of_the_measured_profile() -> None:
    """One frame at a time takes the sum of all stages: 1.25 + 2 + 4 + 4 + 2.25 ms."""
    rows = what_if(measured(), NETWORK, "dsp", BURST)
    (row,) = [each for each in rows if each["name"] == "one frame at a time"]
    assert row["frame_ms"] == pytest.approx(13.5, rel=0.01)


def test_a_table_says_nothing_of_how_sure_it_is_of_this_machine() -> None:
    spec = NetworkSpec("resnet18", "batch", 64, 96, 10)
    of_host, of_chip = (
        next(iter(predict_table(load_profile(name), [ConfigurationRow("rows.csv: line 2", {}, spec)])))
        for name in ("host", "snapdragon-888")
    )
    unsure = {"confidence", "expected_error_gpu", "expected_error_dsp"}
    assert {key for key, value in of_host.items() if value is None} == unsure
    assert all(of_chip[key] > 0 for key in unsure) and of_host.keys() == of_chip.keys()
