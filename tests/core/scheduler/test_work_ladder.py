"""Work is stepped down before frames are late, and up again when there is room: by hand, in virtual time."""

from __future__ import annotations

from collections.abc import Callable
from itertools import pairwise
from pathlib import Path

import pytest

from trilane.scheduler.core import Core
from trilane.scheduler.events import Dispatch, Settings, StageAlone, chain
from trilane.scheduler.policy import MOST_PATIENCE, PATIENCE, WorkLadder
from trilane.scheduler.recording import read, replay
from trilane.scheduler.state import build
from trilane.scheduler.virtual import VirtualDriver

MS = 1_000_000
PERIOD_MS = 20
WORKS = (1000, 563, 250)
#: Milliseconds of all the work.
TIMES = {"pose": 2, "raster": 4, "infer": 10, "composite": 3, "present": 2}
GRAPH = chain(
    (("pose", "cpu"), ("raster", "gpu"), ("infer", "dsp"), ("composite", "gpu"), ("present", "cpu")),
    "double",
    "composite",
)


def run(policy: str, slower: Callable[[int], float], frames: int = 160, **settings: object) -> VirtualDriver:
    """Frames every 20 ms, each to be presented 60 ms after; infer takes `slower(frame)` times as long."""
    found: list[VirtualDriver] = []

    def service(stage: str, _unit: str, frame: int, _begin_ns: int) -> int:
        ns = TIMES[stage] * MS
        if stage != "infer":
            return ns
        return round(ns * slower(frame) * WORKS[found[0].core.frames[frame].rung] / 1000)

    lengths = {"period_ns": PERIOD_MS * MS, "deadline_ns": 3 * PERIOD_MS * MS}
    ladder = {"works": WORKS, "follow": ("infer",)} | settings
    driver = VirtualDriver(GRAPH, Settings(frames, policy, **lengths, **ladder), service, keep=True)  # type: ignore[arg-type]
    found.append(driver)
    driver.run()
    return driver


def steps(driver: VirtualDriver) -> list[tuple[int, int]]:
    """(frame, rung) of each first frame on another rung, by the jobs of pose."""
    assert driver.recording is not None
    actions = [action for _, _, actions in driver.recording.steps for action in actions]
    jobs = [action.job for action in actions if isinstance(action, Dispatch) and action.job.stage == "pose"]
    rungs = [(job.frame, job.rung) for job in jobs]
    return [rungs[0], *(after for before, after in pairwise(rungs) if before[1] != after[1])]


def missed(driver: VirtualDriver, frames: int = 160) -> list[int]:
    """Frames that were presented late, or not at all."""
    ledger = driver.core.ledger
    in_time = {frame for frame, late in zip(ledger.presented_frames, ledger.lateness_ns, strict=True) if late <= 0}
    return sorted(set(range(frames)) - in_time)


def three_times(frame: int) -> float:
    return 3.0 if 20 <= frame < 60 else 1.0


def test_a_step_down_by_hand_and_up_again_under_deadline() -> None:
    """All the work takes 10 of 20 ms, three times that from frame 20 on, and on rung 1 then 16.9, which is 84 %.

    Frame 20 is inferred from 406 to 436 ms, frame 21 until 466: now two of the last three were slow, while frames 22
    and 23 have left pose. 24 is given less, but has to wait for 23; from 25 on no frame is missed. Frame 61 is the
    second fast one; all the work would take half of the period, so after 30 frames, with 90, there is a step up, which
    frame 91 is the first to take.
    """
    driver = run("deadline", three_times)
    assert steps(driver) == [(0, 0), (24, 1), (91, 0)]
    assert missed(driver) == [22, 23, 24]
    without = missed(run("deadline", three_times, works=(), follow=()))
    assert len(without) > 25 and set(without) < set(range(22, 62))


def test_a_step_down_by_hand_under_latest() -> None:
    """As under deadline, but what is late is shown: frames 22 to 24, and 25 gives way to 26, behind that backlog."""
    driver = run("latest", three_times)
    assert steps(driver) == [(0, 0), (24, 1), (91, 0)]
    assert missed(driver) == [22, 23, 24, 25]


@pytest.mark.parametrize("policy", ["latest", "deadline"])
def test_a_cost_that_grows_costs_no_frame(policy: str) -> None:
    """From frame 20 on 4 % more a frame: 18 ms, nine tenths of the period, are passed at frame 41, and then it is
    stepped down while frames are still in time."""
    driver = run(policy, lambda frame: min(1 + max(frame - 20, 0) * 0.04, 3))
    (_, _), (frame, rung) = steps(driver)
    assert rung == 1 and 41 < frame < 46
    assert missed(driver) == []


def test_frames_that_are_all_given_up_are_stepped_down_too() -> None:
    """Seven times as long: 70 ms are more than a frame has, and two of them are inferred to learn that. A quarter takes
    17.5 ms, so none is missed once those that waited for the second are given up."""
    driver = run("deadline", lambda frame: 7.0 if 20 <= frame < 60 else 1.0)
    (_, _), (first, rung), *others = steps(driver)
    assert (first, rung, [rung for _, rung in others]) == (28, 2, [1, 0])
    assert missed(driver) == list(range(20, 35))


def test_one_slow_frame_changes_nothing() -> None:
    assert steps(run("latest", lambda frame: 4.0 if frame % 10 == 5 else 1.0)) == [(0, 0)]


def test_the_rungs_are_replayed(tmp_path: Path) -> None:
    """From the events alone, and from the file."""
    recording = run("deadline", three_times).recording
    assert recording is not None and not list(replay(recording))
    recording.write(tmp_path / "events.jsonl")
    assert read(tmp_path / "events.jsonl") == recording


def ladder(deadline_ns: int = 0) -> WorkLadder:
    """The position of infer is 2; no other stage has taken any time."""
    stages, _, _ = build(GRAPH)
    return WorkLadder(stages, WORKS, ("infer",), PERIOD_MS * MS, deadline_ns)


def test_the_use_by_hand() -> None:
    """Raster 8 and composite 4 ms are the GPU's 600 of 1000; infer 16 ms are 800, on rung 2 a quarter of it."""
    one = ladder()
    for position, ms in ((1, 8), (2, 16), (3, 4)):
        one.learn(position, 0, ms * MS)
    assert [one.use(rung) for rung in range(3)] == [800, 600, 600]
    whole = ladder(30 * MS)
    for position, ms in ((1, 8), (2, 16), (3, 4)):
        whole.learn(position, 0, ms * MS)
    assert [whole.use(rung) for rung in range(3)] == [933, 700, 600]  # 28, 21.008 and 16 of 30 ms


def test_times_alone_replace_the_proportion() -> None:
    """Half of the time on rung 1, and 12 ms now on rung 0, where it took 8 alone: 6 ms on rung 1."""
    one = ladder()
    for rung, ms in enumerate((8, 4, 2)):
        one.set_alone(2, rung, ms * MS)
    one.learn(2, 0, 12 * MS)
    assert [one.service_ns(2, rung) for rung in range(3)] == [12 * MS, 6 * MS, 3 * MS]


def test_no_work_is_left_out_that_saves_nothing() -> None:
    """The GPU takes 30 of 20 ms whatever the tensor; then infer, of 40, is stepped down as far as it helps."""
    one = ladder()
    one.learn(1, 0, 30 * MS)
    one.learn(2, 0, 10 * MS)
    assert (one.consider(), one.rung) == (False, 0)
    other = ladder()
    other.learn(1, 0, 30 * MS)
    other.learn(2, 0, 50 * MS)
    assert (other.consider(), other.rung) == (True, 1)  # 28.2 ms: the GPU's 30 are the most


def test_a_step_up_that_fails_doubles_the_patience() -> None:
    """Rung 0 takes four times as long as alone: it is left for rung 2, and two steps up wait 60, 120 ... frames."""
    one, ups, since = ladder(), [], 0
    one.set_alone(2, 0, 10 * MS)
    one.set_alone(2, 1, 8 * MS)
    one.set_alone(2, 2, 4 * MS)
    for _ in range(6000):
        for _ in range(3):
            one.learn(2, one.rung, (40, 8, 4)[one.rung] * MS)
        before, since = one.rung, since + 1
        one.consider()
        if before and not one.rung:
            ups.append(since)
            since = 0
    assert ups[1:6] == [2 * waited + 1 for waited in (60, 120, 240, 480, 960)]
    assert (PATIENCE, MOST_PATIENCE) == (30, 960)


def test_a_ladder_needs_a_period_and_takes_what_was_measured_before() -> None:
    with pytest.raises(ValueError, match="a ladder of work needs a period"):
        Core(GRAPH, Settings(9, works=WORKS, follow=("infer",)))
    core = Core(GRAPH, Settings(9, "latest", period_ns=MS, works=WORKS, follow=("infer",)))
    core.step(0, (StageAlone("infer", 1, 7 * MS),))
    assert core.ladder is not None
    core.ladder.learn(2, 1, 14 * MS)
    assert core.ladder.service_ns(2, 1) == 14 * MS
    without = Core(GRAPH, Settings(9))
    without.step(0, (StageAlone("infer", 1, 7 * MS),))
    assert without.ladder is None
