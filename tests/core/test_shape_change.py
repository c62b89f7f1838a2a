"""How an old picture of a tensor's shape is laid over the new one: shares, mapping and gaps by hand."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from trilane.bench.lib.layers import Box
from trilane.bench.lib.shape_changes import difference, shape_changes, summed_up
from trilane.stages.gpu.shape_change import FRAMES, MOST_GAP, Blend, ShapeChange
from trilane.stages.packets import pose_dtype

REST = [np.zeros((55, 3))]


def header(picture: int, shape: tuple[int, int], rect: tuple[float, ...], pelvis: tuple[float, float, float]) -> Any:
    """One avatar whose pelvis is at `pelvis` in front of a camera at the origin that looks along -z, focal length 1."""
    pose = np.zeros((), pose_dtype(1))
    pose["picture"], pose["tensor_shape"], pose["avatar_count"] = picture, shape, 1
    pose["view"] = np.eye(4)
    pose["projection"] = np.diag([1.0, 1.0, 1.0, 0.0])
    pose["projection"][3, 2] = -1.0
    avatar = pose["avatars"][0]
    avatar["visible"], avatar["rect"], avatar["tensor_rect"] = 1, rect, (0, 0, *shape)
    avatar["joints"][0] = np.hstack([np.eye(3), np.array(pelvis)[:, None]])
    return pose


SMALL = ((32, 64), (-0.5, -0.25, 0.5, 0.25))
LARGE = ((64, 128), (-0.5, -0.25, 0.5, 0.25))


def change(before: Any, *after: Any) -> list[list[Blend]]:
    made, held, found = ShapeChange(REST), before, []
    for pose in after:
        made.note(held, pose)
        found.append(list(made.blends(pose)))
        held = pose
    return found


def test_the_share_falls_in_equal_steps_and_ends() -> None:
    before = header(10, *LARGE, (0, 0, -2))
    found = change(before, *(header(frame, *SMALL, (0, 0, -2)) for frame in range(11, 17)))
    assert [[one.share for one in each] for each in found] == [[0.75], [0.5], [0.25], [], [], []]
    assert FRAMES == 3
    only = found[0][0]
    assert (only.shape, only.cell, only.part) == ((64, 128), (0, 0, 32, 64), (0, 0, 64, 128))
    assert (only.scale, only.offset) == (pytest.approx((2, 2)), pytest.approx((0, 0)))


def test_the_old_picture_goes_where_the_pelvis_goes_and_grows_with_it() -> None:
    """From 2 m away to 1 m, and from (0, 0) to (0.25, 0.25) of the screen: what was at x is now at 0.25 + 2 x.

    New cell: x 0 to 1 over 64 pixels, y from 1 down to 0 over 32. Its pixel p lies at x = p / 64, was at half of
    p / 64 - 0.25; in the old cell, -0.5 to 0.5 over 128 pixels, it is pixel p - 16 + 64. Its row q lies at 1 - q / 32,
    was at half of 0.75 - q / 32, and the old cell has its row 0 at 0.25 and 128 rows for 1: pixel 2 q - 16.
    """
    before = header(10, *LARGE, (0, 0, -2))
    ((only,),) = change(before, header(11, (32, 64), (0.0, 0.0, 1.0, 1.0), (0.25, 0.25, -1)))
    assert only.scale == pytest.approx((1, 2))
    assert only.offset == pytest.approx((48, -16))


def test_an_old_cell_that_is_not_at_the_corner_is_read_where_it_was() -> None:
    """As before it in all else: 9 columns and 5 rows further; the new cell begins at column 3 and row 7."""
    before = header(10, *LARGE, (0, 0, -2))
    before["avatars"][0]["tensor_rect"] = (5, 9, 64, 128)
    after = header(11, (32, 64), (0.0, 0.0, 1.0, 1.0), (0.25, 0.25, -1))
    after["avatars"][0]["tensor_rect"] = (7, 3, 32, 64)
    ((only,),) = change(before, after)
    assert (only.cell, only.part) == ((7, 3, 32, 64), (5, 9, 64, 128))
    assert only.scale == pytest.approx((1, 2))
    assert only.offset == pytest.approx((48 + 9 - 3, -16 + 5 - 2 * 7))


def test_nothing_is_blended_of_long_ago_of_one_density_of_the_unseen_or_of_one_behind_the_camera() -> None:
    before = header(10, *LARGE, (0, 0, -2))
    for frame, count in ((10 + MOST_GAP, 1), (11 + MOST_GAP, 0), (9, 0)):
        assert len(change(before, header(frame, *SMALL, (0, 0, -2)))[0]) == count
    assert change(before, header(11, *LARGE, (0, 0, -2))) == [[]]
    as_dense = header(11, (64, 96), (-0.375, -0.25, 0.375, 0.25), (0, 0, -2))
    assert change(before, as_dense) == [[]]
    nearer = header(11, (76, 152), LARGE[1], (0, 0, -2))
    assert change(before, nearer) == [[]]  # 19 % more along a side
    assert len(change(before, header(11, (78, 156), LARGE[1], (0, 0, -2)))[0]) == 1  # 22 %
    unseen = header(11, *SMALL, (0, 0, -2))
    unseen["avatars"][0]["visible"] = 0
    assert change(before, unseen) == [[]]
    assert change(before, header(11, *SMALL, (0, 0, 2))) == [[]]
    made = ShapeChange(REST)
    made.note(None, before)
    assert not list(made.blends(before))


def test_nothing_is_blended_of_a_frame_seconds_ago() -> None:
    """At one frame in three seconds the last one is of another place."""
    before = header(10, *LARGE, (0, 0, -2))
    for seconds, count in ((0.19, 1), (0.21, 0), (3.0, 0)):
        after = header(11, *SMALL, (0, 0, -2))
        before["media_time_s"], after["media_time_s"] = 5.0, 5.0 + seconds
        assert len(change(before, after)[0]) == count


def test_a_frame_that_is_drawn_twice_gets_the_same_share_twice() -> None:
    made, before, after = ShapeChange(REST), header(10, *LARGE, (0, 0, -2)), header(11, *SMALL, (0, 0, -2))
    made.note(before, after)
    first = list(made.blends(after))
    made.note(after, after)
    assert list(made.blends(after)) == first and len(first) == 1


def test_a_jump_to_another_part_of_the_scene_ends_a_change() -> None:
    made, before = ShapeChange(REST), header(10, *LARGE, (0, 0, -2))
    after, far = header(11, *SMALL, (0, 0, -2)), header(40, *SMALL, (0, 0, -2))
    made.note(before, after)
    made.note(after, far)
    assert not list(made.blends(far))


class Frames:
    """Grey pictures, and the tensor of each: values grow by 1, 2 at the changes, and by 9 where nobody was before."""

    values = (0, 1, 2, 4, 5, 6, 8, 17, 17)
    tensors = ("a", "a", "a", "b", "b", "b", "a", "none", "a")

    def frame(self, number: int) -> Any:
        self.tensor = self.tensors[number]
        return np.full((4, 6, 3), self.values[number], np.uint8)


class Boxes:
    def boxes(self, _number: int) -> list[Box]:
        return [Box(1, 1, 3, 4)]


def test_changes_of_shape_are_compared_with_the_frames_around_them() -> None:
    found = shape_changes(Frames(), Boxes(), 9)  # type: ignore[arg-type]
    assert [(one.frame, one.before, one.after) for one in found] == [(3, "a", "b"), (6, "b", "a")]
    assert [(one.difference * 255, one.steady * 255) for one in found] == [pytest.approx((2, 1))] * 2
    assert summed_up(found) == {
        **{"count": 2, "worst_ratio": pytest.approx(2), "median_ratio": pytest.approx(2)},
        **{"frame": 3, "from": "a", "to": "b"},
    }
    assert summed_up([])["worst_ratio"] is None
    black, white = np.zeros((4, 6, 3), np.uint8), np.full((4, 6, 3), 255, np.uint8)
    assert difference(black, white, []) == 0
    white[2:] = 0
    assert difference(black, white, [Box(1, 0, 3, 6)]) == pytest.approx(0.5**0.5)
