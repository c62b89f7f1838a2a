"""The CPU unit's stages by their values: intervals and cells by hand, packets against what made them, frames' times."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import av
import numpy as np
import pytest

from support.small_pipeline import assets_of, packet, without_bytes
from trilane.arrays import shape_buckets
from trilane.avatars.bundle import CLOTHES_STANDOFF_M
from trilane.body.joints import Skeleton
from trilane.body.skinning import FrameSkinner
from trilane.errors import TrilaneError
from trilane.pipeline.description import UnitSettings
from trilane.scene.crop import Rect, choose_bucket, grow, lay_out
from trilane.scene.planner import plan_tensor
from trilane.scene.schema import AvatarSpec, CameraSpec, OutputSpec, Scene
from trilane.scene.tensor_budget import TensorBudget
from trilane.stages.avatar_assets import shaped_body, staged_of
from trilane.stages.config import RunConfig, posed_vertices, posed_vertices_bytes
from trilane.stages.cpu import pose
from trilane.stages.cpu.mesh_bounds import MeshBounds
from trilane.stages.cpu.pose import PoseStage
from trilane.stages.cpu.present import Segment

# --- crop ------------------------------------------------------------------------------------------------------------


def test_a_bucket_worked_out_by_hand() -> None:
    """120 x 320 output pixels: 128 x 512 takes 0.9375 of them a tensor pixel, 480 wide; the square takes 320 x 320."""
    rect = Rect(-0.5, -0.25, 0.5, 0.25)
    assert (rect.width, rect.height) == (1.0, 0.5)
    shape, grown = choose_bucket(rect, (480, 640), [(256, 256), (128, 512), (512, 128)])
    assert shape == (128, 512)
    assert grown == pytest.approx((-0.75, -0.25, 0.75, 0.25))
    assert choose_bucket(rect, (480, 640), [(256, 256)])[1] == pytest.approx((-0.5, -2 / 3, 0.5, 2 / 3))
    line = choose_bucket(Rect(0.1, 0.1, 0.1, 0.2), (20, 40), [(64, 64)])[1]  # no width at all counts as one pixel
    assert line == pytest.approx((0.075, 0.1, 0.125, 0.2))


# --- cells -----------------------------------------------------------------------------------------------------------


def brute(sizes: list[tuple[float, float]], buckets: list[tuple[int, int]], margin: int) -> tuple[float, Any, Any]:
    """Scale, shape and rows of the best arrangement: each bucket and number of rows tried in turn."""
    order = sorted(range(len(sizes)), key=lambda k: -sizes[k][0])
    best: tuple[float, Any, Any] = (-math.inf, None, None)
    for number in range(1, len(sizes) + 1):
        each = -(-len(sizes) // number)
        rows = [order[k : k + each] for k in range(0, len(order), each)]
        for shape in buckets:
            high = (shape[0] - margin * (len(rows) - 1) - len(rows)) / sum(max(sizes[k][0] for k in r) for r in rows)
            wide = min((shape[1] - margin * (len(r) - 1) - len(r)) / sum(sizes[k][1] for k in r) for r in rows)
            if min(high, wide) > best[0]:
                best = min(high, wide), shape, rows
    return best


@pytest.mark.parametrize("seed", range(12))
def test_many_avatars_lie_row_by_row_from_the_top_left(seed: int) -> None:
    """Cells follow each other at the margin, tallest first; a row begins below the tallest of the one before."""
    random = np.random.default_rng(seed)
    output, buckets = (480, 640), shape_buckets("256")
    rects = []
    for _ in range(2 + seed % 5):
        x, y = random.uniform(-0.9, 0.4, 2)
        rects.append(Rect(x, y, x + random.uniform(0.1, 0.5), y + random.uniform(0.1, 0.6)))
    sizes = [(r.height * 240, r.width * 320) for r in rects]
    scale, shape, rows = brute(sizes, buckets, 16)
    layout = lay_out(rects, output, buckets)
    assert layout.shape == shape
    top = 0
    for row in rows:
        left = 0
        for k in row:
            height, width = (math.ceil(side * scale) for side in sizes[k])
            crop, cell = layout.crops[k]
            assert cell == (top, left, height, width)
            x0, x1 = grow(rects[k].x0, rects[k].x1, 2 * width / scale / 640)
            y0, y1 = grow(rects[k].y0, rects[k].y1, 2 * height / scale / 480)
            assert crop == pytest.approx((x0, y0, x1, y1))
            left += width + 16
        top += max(math.ceil(sizes[k][0] * scale) for k in row) + 16


# --- pose ------------------------------------------------------------------------------------------------------------


def configured(bundle: Path, out: Path, vertices: int = 0, **scene: Any) -> RunConfig:
    made = Scene(**scene)
    units = {unit: UnitSettings(cores=(0,), threads=1) for unit in ("cpu", "gpu", "dsp")}
    counts = (vertices,) * len(made.avatars) if vertices else ()
    return RunConfig(
        scene=made, out_dir=out, avatar_dirs=(bundle,) * len(made.avatars), units=units, posed_vertices=counts
    )


PAIR = (AvatarSpec(position=(-0.5, 0, 0)), AvatarSpec(position=(0.5, 0, 0.3), motion="builtin:idle"))


@pytest.mark.parametrize("skinned", [False, True], ids=["GPU skins", "CPU skins"])
def test_a_packet_holds_what_motion_camera_and_layout_give(
    tiny_bundle: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, skinned: bool
) -> None:
    """Two avatars at frame 40 of 25 a second, from the same parts put together here."""
    monkeypatch.setattr(pose, "moved_of_kept", lambda _: 1000)
    output = OutputSpec(width=320, height=200)
    first = configured(tiny_bundle, tmp_path, fps=25.0, avatars=PAIR, output=output, plan="fixed")
    assets = assets_of(first)
    body, staged = shaped_body(assets, 0), staged_of(assets)
    total = len(body.vertices)
    config = first.model_copy(update={"posed_vertices": (total, total) if skinned else ()})
    stage, slots = PoseStage(config, assets), [packet(posed_vertices_bytes(config.posed_vertices), 2) for _ in range(2)]
    stage.bind([], slots)
    figures = stage.run(40, None, 1)
    triangles = 2.0 * len(body.body.faces)
    assert without_bytes(figures) == {"visible": 2.0, "level": 5.0, "error_px": 0.0, "triangles": triangles}
    # A camera of 4 x 4, of each avatar 55 x 3 angles and a place, as float64; a header of two avatars; 3 x 4 bytes a
    # vertex, which are read again for the rectangle; and what skinning reads from memory.
    sampled, header, skin = 128 + 2 * 1344, 24 + 168 + 2 * 4628, 2 * total * 12 if skinned else 0
    tables = 2 * 1000 if skinned else 0
    least = sampled + tables + header + skin
    assert [figures[f"bytes_{name}"] for name in ("read", "written", "uploaded", "read_back", "least")] == [
        sampled + tables + skin, header + skin, 0, 0, least
    ]  # fmt: skip
    assert not slots[0].header["avatar_count"]
    header = slots[1].header
    assert (int(header["frame"]), int(header["avatar_count"]), float(header["media_time_s"])) == (40, 2, 1.6)
    view, projection = staged.camera.sample(1.6), staged.camera.projection(1.6, (200, 320))
    np.testing.assert_allclose(header["view"], view, rtol=1e-6)
    np.testing.assert_allclose(header["projection"], projection, rtol=1e-6)
    rects, vertices = [], np.zeros((total, 3), np.float32)
    written = posed_vertices(slots[1].payload, config.posed_vertices)
    for number, mover in enumerate(staged.movers):
        posed = Skeleton(body.joints, body.body.parents).pose(*mover.sample(1.6), mover.world)
        avatar = header["avatars"][number]
        assert (int(avatar["avatar"]), int(avatar["visible"])) == (number, 1)
        np.testing.assert_allclose(avatar["joints"], posed.matrices, rtol=1e-6, atol=1e-6)
        np.testing.assert_allclose(avatar["pose_feature"], posed.feature, rtol=1e-6, atol=1e-6)
        FrameSkinner(body).skin_into(posed, vertices)
        if skinned:
            np.testing.assert_allclose(written[number], vertices, atol=1e-6)
        bounds = MeshBounds(body, standoff_m=CLOTHES_STANDOFF_M)
        rects.append(bounds.rect(posed, projection @ view, vertices if skinned else None))
    layout = lay_out(rects, (200, 320), config.buckets)
    assert tuple(header["tensor_shape"]) == layout.shape
    for number, (crop, cell) in enumerate(layout.crops):
        np.testing.assert_allclose(header["avatars"][number]["rect"], crop, rtol=1e-6)
        assert tuple(header["avatars"][number]["tensor_rect"]) == cell
    stage.close()


def test_a_planned_packet_is_what_the_planner_says_of_the_avatars_on_the_screen(
    tiny_bundle: Path, tmp_path: Path
) -> None:
    """Frame by frame, each after what was held before it: shape, cells, rectangles and density."""
    planned = {"shapes": ((256, 128), (288, 224), (160, 96)), "own_pixels": 256**2}
    config = configured(tiny_bundle, tmp_path, size="auto").model_copy(update=planned)
    assets = assets_of(config)
    body, staged = shaped_body(assets, 0), staged_of(assets)
    stage, slot, held = PoseStage(config, assets), packet(0), None
    stage.bind([], [slot])
    bounds, skeleton = MeshBounds(body, standoff_m=CLOTHES_STANDOFF_M), Skeleton(body.joints, body.body.parents)
    projection = staged.camera.projection(0.0, (480, 640))
    for frame in range(0, 300, 20):
        metrics, t_s = stage.run(frame, None, 0), frame / 30
        posed = skeleton.pose(*staged.movers[0].sample(t_s), staged.movers[0].world)
        rect = bounds.rect(posed, projection @ staged.camera.sample(t_s))
        assert rect is not None
        plan = plan_tensor([rect], (480, 640), config.shapes, TensorBudget(256**2, 512**2), held)
        held = plan.held
        ((crop, cell),) = plan.dense.layout.crops
        avatar = slot.header["avatars"][0]
        assert tuple(slot.header["tensor_shape"]) == plan.dense.layout.shape == stage.plan.shape
        assert tuple(avatar["tensor_rect"]) == cell
        np.testing.assert_allclose(avatar["rect"], crop, atol=1e-6)
        assert metrics["density"] == plan.dense.density


def test_with_nobody_in_view_the_tensor_is_the_smallest(tiny_bundle: Path, tmp_path: Path) -> None:
    off, stays = (AvatarSpec(position=(0, 0, 40.0)),), CameraSpec(place="none")
    config = configured(tiny_bundle, tmp_path, avatars=off, camera=stays, size="256")
    stage, slot = PoseStage(config, assets_of(config)), packet(0)
    stage._buckets = [(64, 64), (20, 100), (50, 50)]
    stage.bind([], [slot])
    stage.run(0, None, 0)
    assert slot.header["tensor_shape"].tolist() == [20, 100]


@pytest.mark.parametrize(
    ("broken", "named"), [("camera", "camera"), ("place", "place of avatar 1"), ("joints", "joints of avatar 0")]
)
def test_what_is_not_finite_is_named(
    tiny_bundle: Path, tmp_path: Path, monkeypatch: Any, broken: str, named: str
) -> None:
    config = configured(tiny_bundle, tmp_path, avatars=PAIR)
    stage = PoseStage(config, assets_of(config))
    stage.bind([], [packet(0, 2)])
    if broken == "camera":
        monkeypatch.setattr(type(stage._camera), "sample", lambda *_: np.full((4, 4), np.inf))
    elif broken == "place":
        mover = stage._actors[1].mover
        pose, _ = mover.sample(0.0)
        for k, place in ((0, np.zeros(3)), (1, np.array([0, np.nan, 0]))):
            moved = type("Still", (), {"sample": lambda _self, _t, place=place: (pose, place), "world": mover.world})()
            object.__setattr__(stage._actors[k], "mover", moved)
    else:
        monkeypatch.setattr(Skeleton, "pose", lambda *_: type("P", (), {"matrices": np.full((55, 3, 4), np.nan)}))
    with pytest.raises(TrilaneError, match=f"frame 9: the {named} is not finite"):
        stage.run(9, None, 0)


def test_posed_vertices_lie_one_body_after_the_other() -> None:
    payload = np.arange(3 * 12 + 5 * 12 + 4, dtype=np.uint8)
    assert posed_vertices_bytes([3, 5]) == 96
    first, second = posed_vertices(payload, [3, 5])
    assert first.shape == (3, 3) and second.shape == (5, 3)
    assert first.tobytes() == payload[:36].tobytes() and second.tobytes() == payload[36:96].tobytes()
    second[:] = 7
    assert payload[36:96].view(np.float32).tolist() == [7.0] * 15
    assert posed_vertices(payload, []) == []


# --- present ---------------------------------------------------------------------------------------------------------


def colours(height: int, width: int) -> np.ndarray:
    """Four flat corners: red, green, blue, grey."""
    frame = np.zeros((height, width, 3), np.uint8)
    frame[: height // 2, : width // 2], frame[: height // 2, width // 2 :] = (200, 30, 40), (30, 180, 60)
    frame[height // 2 :, : width // 2], frame[height // 2 :, width // 2 :] = (40, 50, 210), 128
    return frame


def test_a_segment_is_h264_of_bt709_with_a_key_frame_every_thirty(tmp_path: Path) -> None:
    path = tmp_path / "a.mp4"
    segment = Segment(path, 29.97, 32, 48)
    frames = [*range(31), 35, 33, 33]  # a gap, and numbers that do not rise
    for frame in frames:
        segment.add(frame, colours(32, 48))
    segment.close()
    with av.open(str(path)) as container:
        stream = container.streams.video[0]
        context = stream.codec_context
        assert (context.name, context.pix_fmt, context.width, context.height) == ("h264", "yuv420p", 48, 32)
        shown = list(container.decode(stream))
        assert (shown[0].colorspace, shown[0].color_range) == (1, 1)  # BT.709, MPEG range
        times = [float(frame.time) for frame in shown]
        np.testing.assert_allclose(times, [k * 1001 / 30000 for k in [*range(31), 35, 36, 37]], atol=1e-4)
        assert [k for k, frame in enumerate(shown) if frame.key_frame] == [0, 30]
        luma = shown[0].to_ndarray()[:32].astype(float)
    for row, column, (red, green, blue) in ((8, 12, (200, 30, 40)), (8, 36, (30, 180, 60)), (24, 12, (40, 50, 210))):
        expected = 16 + 219 / 255 * (0.2126 * red + 0.7152 * green + 0.0722 * blue)
        assert luma[row, column] == pytest.approx(expected, abs=3)


def test_a_segment_is_on_the_disk_before_it_is_closed(tmp_path: Path) -> None:
    """All but the last frame can be read, and every digest, as when the writer is killed now."""
    path = tmp_path / "a.mp4"
    segment = Segment(path, 30.0, 32, 48)
    for frame in range(5):
        segment.digest(frame, colours(32, 48))
        segment.add(frame, colours(32, 48))
    with av.open(str(path)) as container:
        assert len(list(container.decode(video=0))) >= 4
    lines = path.with_suffix(".sha256").read_text().splitlines()
    assert [int(line.split()[0]) for line in lines] == list(range(5))
    segment.close()
