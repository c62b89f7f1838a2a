"""How a motion gets onto the floor: outlines, soles, lifts and movers by hand."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
import pytest

from trilane.body.body import ShapedBody
from trilane.body.joints import JOINT_INDEX, Skeleton
from trilane.body.skinning import CpuSkinner
from trilane.scene.motion.motion import Motion, Wrap, rest_leg_m, stance
from trilane.scene.mover import DIRECTIONS, feet, floor_lift, ground_rule, make_mover, outline
from trilane.scene.schema import AvatarSpec


def test_an_outline_is_the_outermost_vertices_of_each_joint(body: ShapedBody) -> None:
    shape = outline(body)
    owner = body.body.weights.argmax(axis=1)
    wanted = set()
    for joint in set(owner.tolist()):
        own = [v for v in range(len(owner)) if owner[v] == joint]
        for direction in DIRECTIONS:
            wanted.add(own[int(np.argmax(body.vertices[own].astype(np.float64) @ direction))])
    rows = sorted(wanted)
    np.testing.assert_array_equal(shape.points[:, :3], body.vertices[rows])
    assert (shape.points[:, 3] == 1).all()
    assert shape.joints.shape == shape.weights.shape == (len(rows), 4)
    np.testing.assert_allclose(shape.weights.sum(axis=1), 1.0)
    pose = np.random.default_rng(1).normal(0, 0.4, 165)
    posed = Skeleton(body.joints, body.body.parents).pose(pose, [0.3, 1.0, -0.2])
    exact = CpuSkinner(body, 4, pose_blend=False).vertices(posed)[rows]
    np.testing.assert_allclose(shape.posed(posed.matrices), exact, atol=1e-6)
    stacked = np.stack([posed.matrices[:, 1] + [0, 0, 0, k] for k in range(35)])  # 35 frames, each 1 m higher
    np.testing.assert_allclose(shape.lowest(stacked), exact[:, 1].min() + np.arange(35), atol=1e-5)
    np.testing.assert_allclose(shape.lowest(stacked[:1]), exact[:, 1].min(), atol=1e-5)


def test_a_leg_is_thigh_and_shin() -> None:
    joints = np.zeros((55, 3))
    joints[JOINT_INDEX["left_hip"]] = 0, 1, 0
    joints[JOINT_INDEX["left_knee"]] = 0.3, 0.6, 0
    joints[JOINT_INDEX["left_ankle"]] = 0.3, 0.6, -0.25
    assert rest_leg_m(joints) == pytest.approx(0.5 + 0.25)


def still(times: list[float], heights: list[float], travels: bool = True, leg_m: float | None = None) -> Motion:
    """The T pose at the given heights of the pelvis."""
    places = np.column_stack([np.arange(len(times)) * 0.5, heights, np.zeros(len(times))])
    return Motion(np.array(times), np.zeros((len(times), 55, 3)), places, None, ("made",), Wrap.BOUNCE, leg_m, travels)


def sole(body: ShapedBody) -> float:
    """How far the lowest vertex of the T pose lies below the pelvis."""
    return float(body.joints[0, 1] - body.vertices[:, 1].min())


def test_which_rule_puts_a_motion_on_the_floor() -> None:
    assert [ground_rule(still([0], [1], travels), "auto") for travels in (True, False)] == ["sequence", "frame"]
    for rule in ("sequence", "frame", "none"):
        assert ground_rule(still([0], [1], False), rule) == rule


def lift(body: ShapedBody, motion: Motion, rule: Any, scale: float = 1.0) -> tuple[list[float], np.ndarray]:
    skeleton = Skeleton(body.joints, body.body.parents)
    times, metres = floor_lift(motion, skeleton, outline(body), -body.joints[0], scale, rule, feet(body))
    return times.tolist(), metres


def test_each_frame_is_lifted_by_its_own_height(body: ShapedBody) -> None:
    times, metres = lift(body, still([0, 0.1, 0.2], [2.0, 2.4, 2.2]), "frame")
    assert times == pytest.approx([k / 30 for k in range(7)])  # 30 a second, more than the motion has
    expected = np.interp(np.arange(7) / 30, [0, 0.1, 0.2], [2.0, 2.4, 2.2])
    assert metres == pytest.approx(sole(body) - expected, abs=1e-5)
    times, metres = lift(body, still([0, 0.01, 0.02], [2.0, 2.4, 2.2]), "frame", scale=0.5)
    assert times == pytest.approx([0, 0.01, 0.02])  # as many as the motion has
    assert metres == pytest.approx(sole(body) - np.array([1.0, 1.2, 1.1]), abs=1e-5)
    assert len(lift(body, still([0, 40.0], [2.0, 2.0]), "frame")[0]) == 600
    standing = dataclasses.replace(still([0, 40.0], [2.0, 2.0]), stance=np.ones(2))
    assert len(lift(body, standing, "stance")[0]) == 1201
    assert lift(body, still([0, 1], [3, 3]), "none") == ([0.0], [0.0])


def test_a_sequence_is_lifted_by_its_fifth_percentile(body: ShapedBody) -> None:
    heights = 1.0 + np.arange(101) / 100
    times, metres = lift(body, still((np.arange(101) / 100).tolist(), heights.tolist()), "sequence")
    assert times == [0.0]
    assert metres == pytest.approx([sole(body) - 1.05], abs=1e-5)


def test_feet_that_stand_are_on_the_floor_and_others_as_high_as_those_on_average(body: ShapedBody) -> None:
    motion = dataclasses.replace(still([0, 0.02, 0.04], [1.0, 1.1, 1.5]), stance=np.array([1.0, 1.0, 0.0]))
    assert ground_rule(motion, "auto") == "stance"
    assert ground_rule(dataclasses.replace(motion, travels=False), "auto") == "frame"
    times, metres = lift(body, motion, "stance")
    assert times == pytest.approx([0, 0.02, 0.04])
    assert metres == pytest.approx(sole(body) - np.array([1.0, 1.1, 1.05]), abs=1e-5)
    half = dataclasses.replace(motion, stance=np.array([1.0, 0.0, 0.5]))
    usual = (1.0 + 0.5 * 1.5) / 1.5  # 1.17: at 1.1 the body would be deeper than 3 cm
    expected = np.array([1.0, 1.13, (usual + 1.5) / 2])
    assert lift(body, half, "stance")[1] == pytest.approx(sole(body) - expected, abs=1e-5)
    deep = dataclasses.replace(still([0, 0.02], [1.0, 0.5]), stance=np.array([1.0, 0.0]))
    assert lift(body, deep, "stance")[1] == pytest.approx(sole(body) - np.array([1.0, 0.5 + 0.03]), abs=1e-5)
    mover = make_mover(AvatarSpec(), motion, body)
    assert mover.notes[0] == "floor: feet that stand in the recording stand on it"


def test_feet_stand_where_they_are_low() -> None:
    """Ankles stand at 0.1, toes at 0.02; one foot on the floor is enough, and from 3 cm on there is less and less."""
    heights = np.tile([[0.1, 0.02], [0.1, 0.02]], (100, 1, 1))
    heights[50] += 0.03
    heights[51] += 0.045
    heights[52] += 0.06
    heights[53] += 0.5
    heights[53, 1] -= 0.5
    heights[54, :, 0] += 0.2  # on the toes
    expected = np.ones(100)
    expected[[50, 51, 52]] = 1, 0.5, 0
    assert stance(heights) == pytest.approx(expected)


def test_a_mover_by_hand(body: ShapedBody) -> None:
    """Legs half as long as the avatar's: places are doubled; the rest pelvis is taken off; the lift is in between."""
    leg = rest_leg_m(body.joints)
    motion = still([0, 1], [0.5, 0.7], leg_m=leg / 2)
    spec = AvatarSpec(position=(1, 2, 3), heading_deg=90, ground="none")
    mover = make_mover(spec, motion, body)
    assert mover.scale == pytest.approx(2.0)
    assert mover.shift == pytest.approx(-body.joints[0])
    assert mover.world == pytest.approx(np.array([[0, 0, 1, 1], [0, 1, 0, 2], [-1, 0, 0, 3], [0, 0, 0, 1]]))
    assert mover.notes == ("floor: heights as recorded", "places scaled by 2.000 for the avatar's legs")
    middle = motion.translation[0] + 0.25 * (motion.translation[1] - motion.translation[0])
    _, place = mover.sample(0.25)
    assert place == pytest.approx(2 * middle - body.joints[0])
    lifted = dataclasses.replace(mover, lift_times_s=np.array([0.0, 0.5, 1.0]), lift_m=np.array([1.0, 3.0, 3.5]))
    for t_s in (0.25, 1.75):  # the motion runs back after a second, and so does the lift
        _, place = lifted.sample(t_s)
        assert place == pytest.approx(2 * middle - body.joints[0] + [0, 2.0, 0])
    assert motion.translation[0].tolist() == [0.0, 0.5, 0.0]


@pytest.mark.parametrize(("ratio", "said"), [(1.009, False), (1.011, True), (0.991, False), (0.989, True)])
def test_a_scale_of_more_than_a_hundredth_is_said(body: ShapedBody, ratio: float, said: bool) -> None:
    mover = make_mover(AvatarSpec(), still([0], [1], leg_m=rest_leg_m(body.joints) / ratio), body)
    assert mover.notes[0] == "floor: the lowest point over the motion touches it"
    assert mover.notes[1:] == ((f"places scaled by {ratio:.3f} for the avatar's legs",) if said else ())
    frame = make_mover(AvatarSpec(), still([0], [1], travels=False), body)
    assert (frame.scale, frame.notes) == (1.0, ("floor: the lowest point of the body touches it in every frame",))
