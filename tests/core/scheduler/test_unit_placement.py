"""Units on cores: placements worked out by hand, and what must hold of any. Times in the tests are in ms."""

from __future__ import annotations

from collections.abc import Mapping
from itertools import permutations, product
from pathlib import Path
from random import Random

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from trilane import machine
from trilane.errors import BadInputError
from trilane.hw_profiles.host import asked_cores, host_cores, rule_placement, settings_of
from trilane.machine import Machine
from trilane.scheduler import placement
from trilane.scheduler.placement import (
    CpuCore,
    Place,
    Placement,
    Ranked,
    Rules,
    Times,
    UnitWork,
    busiest_core_ns,
    chosen,
    fastest,
    frame_ns,
    placements,
    ranked,
    typical,
    worth_trying,
)

MS = 1_000_000
FIRST = Rules("cpu")


@pytest.fixture(autouse=True)
def without_costs(monkeypatch: pytest.MonkeyPatch) -> None:
    """By hand, nothing but the work counts; one test is about the costs."""
    for name in ("SCHEDULER_NS", "CHANGE_NS", "MOVE_NS"):
        monkeypatch.setattr(placement, name, 0)
    monkeypatch.setattr(placement, "ROOM_USED", 1.0)


def equal(count: int) -> list[CpuCore]:
    return [CpuCore(number, number) for number in range(count)]


def work(ms: float, jobs: int = 1) -> UnitWork:
    return UnitWork(round(ms * MS), round(ms * MS), jobs)


def times(cpu: float, gpu: float, dsp: float | Mapping[int, float]) -> Times:
    threads = dsp if isinstance(dsp, Mapping) else {1: dsp}
    return {"cpu": {1: work(cpu, 2)}, "gpu": {1: work(gpu, 2)}, "dsp": {n: work(ms) for n, ms in threads.items()}}


def on(
    cpu: int | tuple[int, ...], gpu: int | tuple[int, ...], dsp: int | tuple[int, ...], threads: int = 1
) -> Placement:
    cpu, gpu, dsp = ((cores,) if isinstance(cores, int) else cores for cores in (cpu, gpu, dsp))
    return {"cpu": Place(cpu, 1), "gpu": Place(gpu, 1), "dsp": Place(dsp, threads)}


def ms(where: Placement, of: Times, cores: list[CpuCore], rules: Rules = FIRST) -> float:
    return frame_ns(where, cores, of, rules) / MS


def test_on_one_core_a_frame_is_the_sum() -> None:
    (only,) = ranked(equal(1), times(6, 13, 7), FIRST)
    assert only == Ranked(on(0, 0, 0), 26 * MS)


@pytest.mark.parametrize(
    ("where", "frame"),
    [
        (on(0, 0, 1), 19),  # 6 + 13 on the one, 7 on the other
        (on(0, 1, 0), 13),  # 6 + 7 and 13
        (on(0, 1, 1), 20),  # 13 + 7
        (on((0, 1), 0, 1), 13),  # half of all is 13, and the GPU unit needs 13
        (on((0, 1), 0, 0), 20),  # 20 on core 0, and the floating one has the other
        (on(0, 1, (0, 1)), 13),
    ],
)
def test_on_two_cores_the_fuller_one_decides(where: Placement, frame: float) -> None:
    assert ms(where, times(6, 13, 7), equal(2)) == frame


def test_of_a_small_network_the_cpu_unit_goes_to_its_core_and_of_a_large_one_to_the_gpu_units() -> None:
    """What was seen at 256x256 and at 512x512."""
    rule = on(0, 0, 1)
    small, large = times(6, 13, {1: 7, 2: 4}), times(6, 23, {1: 33, 2: 18})
    for of, expected in ((small, on(0, 1, 0)), (large, rule)):
        found = ranked(equal(2), of, FIRST)
        assert chosen(found, Ranked(rule, frame_ns(rule, equal(2), of, FIRST))).placement == expected


def test_threads_on_shared_cores_wait_for_the_slowest() -> None:
    """(T - 15)(T - 7) = 11 T, from T (1 - 15/T)(1 - 7/T) = 11: T = (33 + sqrt(669)) / 2."""
    assert ms(on(1, 0, (0, 1), 2), times(7, 15, {1: 20, 2: 11}), equal(2)) == pytest.approx((33 + 669**0.5) / 2)


def test_a_network_that_is_much_the_slowest_has_threads_on_both_cores() -> None:
    """T (1 - 25/T) = 130 with the others on one of the cores, T (1 - 8/T)(1 - 17/T) = 130 with one on each."""
    of = times(8, 17, {1: 250, 2: 130})
    found = ranked(equal(2), of, FIRST)
    assert chosen(found, Ranked(on(0, 0, 1), 250 * MS)) == Ranked(on(0, 0, (0, 1), 2), 155 * MS)
    assert ms(on(0, 1, (0, 1), 2), of, equal(2)) == pytest.approx((155 + (155**2 - 4 * 136) ** 0.5) / 2)


def test_on_eight_cores_more_threads_shorten_the_latency_when_the_rate_is_the_same() -> None:
    network = {1: 20, 2: 11, 4: 7, 5: 6, 6: 5, 7: 4.8, 8: 4.7}
    best = ranked(equal(8), times(6, 15, network), FIRST)[0]
    assert best == Ranked(on(0, 1, (2, 3, 4, 5, 6, 7), 6), 15 * MS)


def test_one_frame_at_a_time_is_the_sum_and_sharing_costs_nothing() -> None:
    best = ranked(equal(2), times(6, 15, {1: 20, 2: 11}), Rules("cpu", sequential=True))[0]
    assert best.frame_ns == 32 * MS
    assert best.placement["dsp"] == Place((0, 1), 2)


def test_siblings_together_do_a_quarter_more_than_one() -> None:
    one_core = [CpuCore(0, 0), CpuCore(1, 0)]
    assert ms(on(0, 1, 1), times(10, 5, 5), one_core) == 20 / 1.25
    two_cores = [*one_core, CpuCore(2, 2), CpuCore(3, 2)]
    best = ranked(two_cores, times(1, 10, 10), FIRST)[0]
    physical = {core.number: core.physical for core in two_cores}
    assert physical[best.placement["gpu"].cores[0]] != physical[best.placement["dsp"].cores[0]]


def test_two_threads_on_one_physical_core_are_slower_than_on_two() -> None:
    cores = [CpuCore(0, 0), CpuCore(1, 0), CpuCore(2, 2), CpuCore(3, 2), CpuCore(4, 4), CpuCore(5, 4)]
    of = times(1, 1, {2: 10})
    assert ms(on(2, 3, (0, 4), 2), of, cores) == 10
    assert ms(on(2, 3, (0, 1), 2), of, cores) == 16
    assert ms(on(2, 3, (0, 1), 2), of, cores, Rules("cpu", sequential=True)) == 1 + 1 + 16


def test_the_slowest_unit_has_the_fastest_core() -> None:
    cores = [CpuCore(0, 0, 500), CpuCore(1, 1, 500), CpuCore(2, 2, 1000)]
    best = ranked(cores, times(4, 5, 20), FIRST)[0]
    assert best == Ranked(on(0, 1, 2), 20 * MS)
    assert ms(on(2, 1, 0), times(4, 5, 20), cores) == 40
    assert ms(on(1, 1, (0, 2), 2), times(4, 5, {2: 15}), cores) == 30  # its threads wait for the slower core


def test_units_that_float_between_different_cores_share_what_these_can_do() -> None:
    """10 + 10 + 8 + 8 on three cores; on two of them it is never more than 10 + 8."""
    where = {"cpu": Place((0, 1), 1), "b": Place((1, 2), 1), "c": Place((0,), 1), "d": Place((2,), 1)}
    of = {unit: {1: work(ms)} for unit, ms in (("cpu", 10), ("b", 10), ("c", 8), ("d", 8))}
    assert ms(where, of, equal(3)) == 12


def test_a_device_needs_its_core_only_to_be_told() -> None:
    of = {**times(6, 0, 12), "gpu": {1: UnitWork(20 * MS, 2 * MS, 2)}}
    assert ms(on(0, 0, 1), of, equal(2)) == 20
    assert ms(on(0, 0, 0), of, equal(2)) == 20
    assert ms(on(0, 0, 0), {**of, "dsp": {1: work(15)}}, equal(2)) == 23


def test_what_a_change_of_threads_a_move_and_the_scheduler_take(monkeypatch: pytest.MonkeyPatch) -> None:
    of = times(5, 10, 20)  # two, two and one jobs
    monkeypatch.setattr(placement, "CHANGE_NS", MS)
    assert [ms(on(0, 0, 1), of, equal(2)), ms(on(0, 1, 0), of, equal(2))] == [20, 28]
    monkeypatch.setattr(placement, "MOVE_NS", 2 * MS)
    assert ms(on(0, 1, (0, 1)), of, equal(2)) == 20 + 1 + 2  # its one job, and the move of a frame
    assert ms(on(0, 0, (0, 1)), of, equal(2)) == 20  # it stays on core 1, where nobody else is
    monkeypatch.setattr(placement, "SCHEDULER_NS", 4 * MS)
    assert ms(on(0, 0, 1), of, equal(2)) == 5 + 10 + 4 + 5 * 4
    assert ms(on(0, 0, 1), of, equal(2), Rules("dsp")) == 20 + 5 * 4
    assert ms(on(0, 1, 2), of, equal(3), Rules("cpu", sequential=True)) == 35 + 5 * 4


def test_a_unit_that_floats_stays_where_nobody_else_is(monkeypatch: pytest.MonkeyPatch) -> None:
    """And what it leaves may be the core where another one that floats can stay."""
    for name, value in (("MOVE_NS", 99 * MS), ("ROOM_USED", 0.5)):
        monkeypatch.setattr(placement, name, value)
    of = times(6, 13, 7)
    assert ms(on(0, (0, 1), 0), of, equal(2)) == ms(on(0, 1, 0), of, equal(2)) == 13
    assert ms(on((0, 1), (1, 2), 0), of, equal(3)) == 13  # the GPU unit on core 2, then the CPU unit on core 1
    assert ms(on((0, 1), 1, 0), of, equal(3)) > 99  # nowhere, so it is moved


def test_of_what_cores_can_do_for_units_that_float_a_tenth_is_lost(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(placement, "ROOM_USED", 0.9)
    of = times(9, 9, 9)
    assert ms(on((0, 1), 0, 1), of, equal(2)) == 15  # 27 / 2 / 0.9
    assert ms(on(0, 0, 1), of, equal(2)) == 18
    assert ranked(equal(2), of, FIRST)[0].placement == on(0, (0, 1), 1)


def test_ties_go_to_fewer_shared_cores_then_to_lower_numbers() -> None:
    found = ranked(equal(3), times(5, 5, 5), FIRST)
    assert found[0].placement == on(0, 1, 2)
    same = [each.placement for each in found if each.frame_ns == found[0].frame_ns]
    assert [len(placement.shared_cores(each)) for each in same] == sorted(len(placement.shared_cores(e)) for e in same)


def test_what_is_hardly_better_than_the_rule_is_not_taken() -> None:
    rule, better, much_better = Ranked(on(0, 0, 1), 100), Ranked(on(0, 1, 0), 98), Ranked(on(0, 1, 0), 90)
    floating, shared = Ranked(on((0, 1), 0, 1), 89), Ranked(on(0, 1, (0, 1)), 88)
    assert chosen([better, rule], rule) == rule
    assert chosen([shared, floating, much_better, rule], rule) == much_better
    assert chosen([Ranked(shared.placement, 80), much_better, rule], rule).frame_ns == 80


def test_what_the_model_cannot_tell_apart_is_tried_and_the_rule_always() -> None:
    """The one that the model would take comes first; a quarter more than the shortest is the limit; five at most."""
    rule = Ranked(on(0, 0, 1), 200)
    shortest, near, far = Ranked(on(0, 1, (0, 1)), 100), Ranked(on(0, 1, 0), 102), Ranked(on(0, 1, 1), 126)
    assert worth_trying([shortest, near, far, rule], rule) == [near, rule, shortest]
    many = [Ranked(on(0, 1, n), 100 + 5 * n) for n in range(9)]
    assert worth_trying([*many, rule], rule) == [many[0], rule, *many[1:4]]
    best = rule._replace(frame_ns=100)
    assert worth_trying([best, near, far], best) == [best, near]


def test_the_fastest_in_most_rounds_is_the_fastest() -> None:
    """The second is 10 % faster in three rounds; in the fourth all are slow, and it is the slowest by chance."""
    assert typical([[100, 90, 120], [100, 90, 120], [100, 90, 120], [500, 900, 600]]) == [100, 90, 120]
    assert fastest([100, 99.5, 120]) == 0  # the same: the first stays
    assert fastest([100, 98.5, 98.0]) == 1
    assert fastest([7.0]) == 0


def test_given_places_stay() -> None:
    given_ = {"gpu": Place((1,), 1)}
    found = ranked(equal(2), times(6, 13, {1: 7, 2: 4}), FIRST, given_)
    assert {each.placement["gpu"] for each in found} == {given_["gpu"]}
    assert found[0].placement == on(0, 1, 0)
    with pytest.raises(ValueError, match="no placement"):
        ranked(equal(1), {**times(1, 1, 1), "dsp": {2: work(1)}}, FIRST)


#: What may be exchanged of two physical cores with two siblings each: the siblings of each, and the cores.
OF_SIBLINGS = [(a, b, c, d) for a, b, c, d in permutations(range(4)) if {a, b} in ({0, 1}, {2, 3})]


@pytest.mark.parametrize(
    ("cores", "exchanges", "network"),
    [
        (equal(1), list(permutations(range(1))), {1: 8}),
        (equal(2), list(permutations(range(2))), {1: 8, 2: 5}),
        (equal(3), list(permutations(range(3))), {1: 8, 2: 5, 3: 4}),
        ([CpuCore(0, 0), CpuCore(1, 0), CpuCore(2, 2), CpuCore(3, 2)], OF_SIBLINGS, {1: 8}),
    ],
)
def test_every_placement_is_there_once(
    cores: list[CpuCore], exchanges: list[tuple[int, ...]], network: dict[int, float]
) -> None:
    """Against all of them, without a thought for symmetry; the predictions of equal ones are equal."""
    of, count = times(3, 5, network), len(cores)
    numbers = range(count)
    single = [Place(own, 1) for own in [(n,) for n in numbers] + [(a, b) for a in numbers for b in numbers if a < b]]
    gangs = [Place((0, 1), 2), Place((0, 2), 2), Place((1, 2), 2), Place((0, 1, 2), 3)]
    of_network = [*single, *(gang for gang in gangs if gang.threads in network and max(gang.cores) < count)]

    def kind(where: Placement) -> tuple[object, ...]:
        renumbered = [
            tuple((tuple(sorted(to[core] for core in place.cores)), place.threads) for place in where.values())
            for to in exchanges
        ]
        return min(renumbered)

    everything: dict[tuple[object, ...], set[int]] = {}
    for cpu, gpu, dsp in product(single, single, of_network):
        where = {"cpu": cpu, "gpu": gpu, "dsp": dsp}
        everything.setdefault(kind(where), set()).add(frame_ns(where, cores, of, FIRST))
    found = list(placements(cores, of, {}))
    assert sorted(map(kind, found), key=str) == sorted(everything, key=str)
    assert all(len(frames) == 1 for frames in everything.values())


POSITIVE = st.integers(1, 200)


@st.composite
def machines(draw: st.DrawFn) -> tuple[list[CpuCore], Times]:
    count = draw(st.sampled_from([1, 2, 3, 4]))
    siblings = draw(st.booleans()) and count % 2 == 0
    cores = [CpuCore(n, n // 2 if siblings else n, draw(st.sampled_from([500, 1000]))) for n in range(count)]
    network = {n: draw(POSITIVE) for n in {1, max(1, count - 2), *draw(st.sets(st.integers(1, count)))}}
    return cores, times(draw(POSITIVE), draw(POSITIVE), network)


@settings(max_examples=25)
@given(machines(), st.booleans())
def test_what_is_chosen_is_never_predicted_worse_than_the_rule(machine: tuple[list[CpuCore], Times], one: bool) -> None:
    cores, of = machine
    where, rules = rule_placement(tuple(core.number for core in cores)), Rules("cpu", one)
    rule = Ranked(where, frame_ns(where, cores, of, rules))
    found = ranked(cores, of, rules)
    assert found[0].frame_ns <= chosen(found, rule).frame_ns <= rule.frame_ns
    assert found[0].frame_ns * (1 + 0.04) >= chosen(found, rule).frame_ns


@settings(max_examples=25)
@given(machines(), st.randoms(use_true_random=False), st.booleans())
def test_which_number_a_core_has_changes_no_prediction(
    machine: tuple[list[CpuCore], Times], random: Random, one: bool
) -> None:
    cores, of = machine
    numbers = [core.number for core in cores]
    random.shuffle(numbers)
    exchanged = [CpuCore(number, core.physical, core.permille) for core, number in zip(cores, numbers, strict=True)]
    before, after = (ranked(these, of, Rules("cpu", one)) for these in (cores, sorted(exchanged)))
    assert [each.frame_ns for each in before] == [each.frame_ns for each in after]


@settings(max_examples=25)
@given(machines(), st.sampled_from(["cpu", "gpu", "dsp"]), st.integers(1, 50), st.booleans())
def test_more_work_never_makes_a_frame_shorter(
    machine: tuple[list[CpuCore], Times], unit: str, more: int, one: bool
) -> None:
    cores, of = machine
    rules = Rules("cpu", one)
    larger = {
        **of,
        unit: {n: UnitWork(w.serial_ns + more * MS, w.core_ns + more * MS, w.jobs) for n, w in of[unit].items()},
    }
    for where in placements(cores, of, {}):
        assert frame_ns(where, cores, larger, rules) >= frame_ns(where, cores, of, rules)


@pytest.mark.parametrize(
    ("where", "busiest"),
    [
        (on(0, 0, 1), 19),
        (on(0, 1, 0), 13),
        (on((0, 1), 0, 1), 13),
        (on((0, 1), 0, 0), 20),
        (on((0, 1), (0, 1), (0, 1)), 13),
        (on(1, 0, (0, 1), 2), 20),  # 13 + 7: the threads of a job have a core each
    ],
)
def test_the_work_of_the_busiest_core(where: Placement, busiest: float) -> None:
    assert busiest_core_ns(where, {"cpu": 6.0, "gpu": 13.0, "dsp": 7.0}) == busiest


def test_threads_spin_only_where_no_other_unit_is() -> None:
    spins = {unit: of.spin for unit, of in settings_of(on(0, 0, (1, 2), 2)).items()}
    assert spins == {"cpu": False, "gpu": False, "dsp": True}
    assert not any(of.spin for of in settings_of(on((0, 1), 0, (1, 2), 2)).values() if of.cores != (0,))


def test_the_rule_for_any_run_gives_way_to_what_was_asked() -> None:
    assert rule_placement((0, 1)) == on(0, 0, 1)
    assert rule_placement((0, 1), {"dsp": (0, 1)}) == on(0, 0, (0, 1), 2)


@pytest.fixture
def three_usable(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(machine.here, "cores", lambda: (0, 1, 3))


@pytest.mark.usefixtures("three_usable")
def test_cores_as_asked() -> None:
    assert asked_cores(["cpu=1", "dsp=3,0-1"]) == {"cpu": (1,), "dsp": (0, 1, 3)}
    assert asked_cores([]) == {}


@pytest.mark.usefixtures("three_usable")
@pytest.mark.parametrize(
    ("texts", "said"),
    [
        (["tpm=1"], "unknown unit 'tpm', expected one of cpu, gpu, dsp$"),
        (["dps=1"], "unknown unit 'dps', expected one of cpu, gpu, dsp; did you mean 'dsp'"),
        (["GPU=1"], "unknown unit 'GPU', expected one of cpu, gpu, dsp; did you mean 'gpu'"),
        (["cpu=1", "cpu=0"], "unit cpu twice"),
        (["cpu=0,2"], "core 2 for unit cpu, expected cores that this process may use: 0, 1, 3"),
        (["cpu="], "'cpu=', expected UNIT=LIST"),
        (["cpu"], "'cpu', expected UNIT=LIST"),
        (["cpu=1-0"], "'cpu=1-0', expected UNIT=LIST"),
        (["cpu=x"], "expected UNIT=LIST"),
        (["cpu=0,0"], "a core twice"),
    ],
)
def test_cores_that_cannot_be_are_refused(texts: list[str], said: str) -> None:
    with pytest.raises(BadInputError, match=f"--cores: found .*{said}"):
        asked_cores(texts)


def test_what_the_kernel_says_of_cores(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(machine, "here", Machine(tmp_path))
    tmp_path /= "sys/devices/system/cpu"
    for number, (siblings, capacity) in enumerate([("0,2", 512), ("1,3", 1024), ("0,2", 512), ("1,3", 1024)]):
        (tmp_path / f"cpu{number}" / "topology").mkdir(parents=True)
        (tmp_path / f"cpu{number}" / "topology" / "thread_siblings_list").write_text(f"{siblings}\n")
        (tmp_path / f"cpu{number}" / "cpu_capacity").write_text(f"{capacity}\n")
    assert host_cores((0, 1, 2)) == (CpuCore(0, 0, 500), CpuCore(1, 1, 1000), CpuCore(2, 0, 500))
    assert host_cores((7, 8)) == (CpuCore(7, 7, 1000), CpuCore(8, 8, 1000))
    for number, clock in enumerate((3_000_000, 4_000_000)):
        (tmp_path / f"cpu{number}" / "cpu_capacity").write_text("1024\n")
        (tmp_path / f"cpu{number}" / "cpufreq").mkdir()
        (tmp_path / f"cpu{number}" / "cpufreq" / "cpuinfo_max_freq").write_text(f"{clock}\n")
    assert [core.permille for core in host_cores((0, 1))] == [750, 1000]
