"""The placements that are worth trying, against a simulated kernel: among them is one that is as good as any.

Rule: a second implementation (`support.sliced_kernel`). The model is a formula; this is time going by.
"""

from __future__ import annotations

import pytest

from support.sliced_kernel import CORES, FRAMES, STEP_MS, WARM, placed_frame_ms
from trilane.scheduler.placement import Ranked, Rules, Times, UnitWork, ranked, worth_trying

FIRST = Rules("cpu")
RULE = "[(0,), (0,), (1,)]"


def cores_of(each: Ranked) -> str:
    return str([place.cores for place in each.placement.values()])


def of_one_thread(ms: dict[str, float]) -> Times:
    return {
        unit: {1: UnitWork(round(1e6 * own), round(1e6 * own), 1 if unit == "dsp" else 2)} for unit, own in ms.items()
    }


@pytest.mark.parametrize(
    ("cpu", "gpu", "dsp"),
    [(6, 13, 7), (6, 23, 31), (3.5, 15.7, 14.7), (5.3, 8, 23.8)],  # 256x256, 512x512 on two cores, and drawn at random
)
def test_among_those_that_are_tried_is_one_as_good_as_any(cpu: float, gpu: float, dsp: float) -> None:
    ms = {"cpu": cpu, "gpu": gpu, "dsp": dsp}
    times = of_one_thread(ms)
    found = ranked(CORES, times, FIRST)
    rule = next(each for each in found if cores_of(each) == RULE)
    tried = [each.placement for each in worth_trying(found, rule)]
    frames = [(placed_frame_ms(each.placement, ms), each.placement in tried) for each in found]
    assert len(found) == 14
    assert min(frame for frame, is_tried in frames if is_tried) <= 1.03 * min(frame for frame, _ in frames)


def test_the_kernel_that_is_simulated_does_what_can_be_worked_out() -> None:
    """On one core the sum, on two the fuller one's. A job ends with a step, and rounding may add another one; of the
    frames between the first and the last that count, what was under way differs by one at most."""
    ms = {"cpu": 6.0, "gpu": 13.0, "dsp": 7.0}
    found = {cores_of(each): each for each in ranked(CORES, of_one_thread(ms), FIRST)}
    for where, jobs, frame_ms in (("[(0,), (0,), (0,)]", 5, 26), (RULE, 4, 19)):
        under_way = frame_ms / (FRAMES - 1 - WARM)
        simulated = placed_frame_ms(found[where].placement, ms, 0.0)
        assert frame_ms - under_way <= simulated <= frame_ms + under_way + jobs * 2 * STEP_MS
