"""How errors by cause add up, on made-up pictures; the causes, the bodies and the heat maps against closed forms."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import onnxruntime
import pytest
from PIL import Image

from support.small_inputs import net
from trilane.apps.experiments import error_by_cause
from trilane.apps.experiments.picture_errors import ErrorFigures
from trilane.apps.experiments.reference_path import (
    BODY,
    NOTHING,
    Cause,
    Causes,
    ReferenceFrame,
    RunBody,
    require_complete,
)
from trilane.apps.experiments.scene_pictures import region
from trilane.arrays import F64
from trilane.avatars.bundle import bundle_folder, load_bundle
from trilane.avatars.network_file import check_network, reshaped
from trilane.bench.lib.cast import Box, RasterLayer
from trilane.bench.lib.full_picture import as_written
from trilane.body.body import load_body
from trilane.body.joints import Skeleton
from trilane.body.skinning import DETAILS
from trilane.errors import BadInputError
from trilane.stages.avatar_assets import AvatarData

OUTPUT = (12, 16)
EYE = np.eye(4)


class MadeUp:
    """A moment whose causes each add a picture of their own; as (12,16,3) around grey."""

    background: Any = None
    number, boxes, seen = 3, (Box(2, 3, 8, 9),), {0: None}

    def __init__(self, seed: int, still: Causes = NOTHING) -> None:
        rng = np.random.default_rng(seed)
        self._adds = {
            cause: np.zeros((*OUTPUT, 3)) if cause in still else rng.normal(0, 0.01, (*OUTPUT, 3)) for cause in Cause
        }
        self.own = self.frame(frozenset(Cause)).picture

    def frame(self, causes: Causes) -> ReferenceFrame:
        require_complete(causes)
        picture = 0.5 + sum((self._adds[cause] for cause in causes), np.zeros((*OUTPUT, 3)))
        return ReferenceFrame(self.number, picture, picture[..., 0] > 0.5, self.boxes)

    def vertices(self, index: int, causes: Causes) -> F64:
        assert index == 0
        right = 0.001 if Cause.WEIGHTS in causes else 0.0
        return np.array([[right, 0, -2], [right, 0, 2]])

    def clip(self, index: int) -> F64:
        """Of a camera at the origin: w = -z, x and y go to ±1 at 45 degrees."""
        assert index == 0
        clip = EYE.copy()
        clip[3] = [0, 0, -1, 0]
        return clip


@pytest.fixture(autouse=True)
def _plain_figures(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(
        error_by_cause, "figures", lambda *_: ErrorFigures(mae=0, psnr_db=0, ssim=0.5, ms_ssim=None, flip=0.25)
    )


def document(*moments: Any) -> dict[str, Any]:
    split = error_by_cause._Split(OUTPUT, None)
    for moment in moments:
        split.add(moment)
    return split.document()


def test_in_order_the_parts_are_the_whole() -> None:
    """By construction, over frames of different content; alone they are not, and what they leave is said."""
    found = document(MadeUp(0), MadeUp(1))
    whole, sums = found["whole"], found["sums"]
    assert whole["mae"] > 1 and whole["square"] > 1
    for key, of in (("mae", "mae"), ("square", "square"), ("product", "square")):
        assert sum(row["adds"][key] for row in found["causes"]) == pytest.approx(whole[of], rel=1e-12)
        assert abs(sums["left_in_order"][key]) < 1e-9
    alone = sum(row["alone"]["square"] for row in found["causes"])
    assert sums["left_alone"]["square"] == pytest.approx(whole["square"] - alone)
    assert abs(sums["left_alone"]["mae"]) > 1
    assert found["remainder"]["mae"] == 0 and found["truth"] is None


def test_the_figures_are_of_the_region_and_in_steps() -> None:
    """One cause, of the same size everywhere: its MAE and its mean square, alone, in order and of the whole."""
    moment = MadeUp(0, frozenset(Cause) - {Cause.FLOAT16})
    moment._adds[Cause.FLOAT16] = np.full((*OUTPUT, 3), 2 / 255)
    moment.own = moment.frame(frozenset(Cause)).picture
    found = document(moment)
    rows = {row["cause"]: row for row in found["causes"]}
    for figures in (rows["FP16 texture"]["alone"], rows["FP16 texture"]["step"], found["whole"]):
        assert figures["mae"] == pytest.approx(2)
        assert figures["square"] == pytest.approx(4)
        assert figures["psnr_db"] == pytest.approx(20 * np.log10(255 / 2))
        assert (figures["ssim"], figures["ms_ssim"], figures["flip"]) == (0.5, None, 0.25)
    assert rows["FP16 texture"]["adds"] == pytest.approx({"mae": 2, "square": 4, "product": 4})
    for name, row in rows.items():
        if name != "FP16 texture":
            assert row["alone"]["mae"] == row["step"]["square"] == row["adds"]["product"] == 0


def test_what_the_run_s_own_frames_have_besides_is_the_remainder() -> None:
    moment = MadeUp(0)
    moment.own = moment.own + 3 / 255
    assert document(moment)["remainder"]["mae"] == pytest.approx(3)


def test_the_truth_is_laid_over_the_frame_s_background() -> None:
    """White of half the cover over black, in the box alone: what both pictures, grey, are from it."""
    moment = MadeUp(0, frozenset(Cause))
    moment.background = np.zeros((*OUTPUT, 3), np.uint8)
    light = np.full((6, 6, 4), 0.5)
    split = error_by_cause._Split(OUTPUT, None)
    split.add_truth(moment, [RasterLayer(Box(2, 3, 8, 9), -1.0, light)])
    split.add(moment)
    found = split.document()["truth"]
    half_light = 1.055 * 0.5 ** (1 / 2.4) - 0.055
    inside = 36 / (OUTPUT[0] * OUTPUT[1])
    for figures in (found["reference"], found["run"]):
        assert figures["mae"] == pytest.approx(255 * (inside * (half_light - 0.5) + (1 - inside) * 0.5))


def test_how_far_the_vertices_move() -> None:
    """A millimetre, of both; at two metres before the camera 16 / 2 / 2 pixels a metre; behind it there are none."""
    moved = {row["cause"]: row["moved"] for row in document(MadeUp(0))["causes"]}
    assert moved["skin weights"] == pytest.approx({"largest_mm": 1, "mean_mm": 1, "largest_px": 0.004})
    assert moved["blend shapes"] == {"largest_mm": 0, "mean_mm": 0, "largest_px": 0}
    assert [name for name, figures in moved.items() if figures is None] == [str(c) for c in Cause if c not in BODY]


@pytest.mark.parametrize(
    ("boxes", "wanted"),
    [
        ([Box(10, 20, 200, 60)], Box(10, 0, 200, 176)),
        ([Box(0, 500, 30, 640), Box(300, 400, 400, 500)], Box(0, 400, 400, 640)),
        ([Box(470, 600, 480, 640)], Box(304, 464, 480, 640)),
    ],
)
def test_the_region_holds_the_boxes_with_room_for_ms_ssim(boxes: list[Box], wanted: Box) -> None:
    assert region(boxes, (480, 640)) == wanted


def test_the_region_of_a_small_picture_is_the_picture() -> None:
    assert region([Box(3, 3, 6, 6)], (64, 300)) == Box(0, 0, 64, 176)


def body_data(posedirs: Any) -> AvatarData:
    """The default body with pose blend shapes; the network is not looked at."""
    bundle = load_bundle("default")
    shaped = replace(load_body(bundle_folder("default") / "body.npz"), posedirs=posedirs).shape()
    return AvatarData(bundle, shaped, np.zeros((1, 1, 4), np.float32), bundle.read_network())


@pytest.fixture(scope="module")
def bent() -> Any:
    """An avatar in a frame, bent everywhere."""
    rng = np.random.default_rng(3)
    world = EYE.copy()
    world[:3, 3] = [1, 0, -4]
    return SimpleNamespace(pose=rng.normal(0, 0.4, (55, 3)), translation=np.array([0.0, 0.9, 0]), world=world)


@pytest.fixture(scope="module")
def posedirs() -> Any:
    body = load_body(bundle_folder("default") / "body.npz")
    found = np.zeros((len(body.v_template), 3, 486), np.float32)
    found[:200] = np.random.default_rng(1).normal(0, 1e-3, (200, 3, 486))
    return found


def test_leaving_out_blend_shapes_moves_what_they_move(bent: Any, posedirs: Any) -> None:
    """By the blend shapes' own length: rotations keep it, and these vertices hang on rigid motions' shares."""
    data = body_data(posedirs)
    body = RunBody(data, on_cpu=True)
    without = next(level for level, detail in enumerate(DETAILS) if not detail.pose_blend and detail.weight_count == 8)
    causes = frozenset({Cause.BLEND})
    moved = np.linalg.norm(body.vertices(bent, without, causes) - body.vertices(bent, without, NOTHING), axis=1)
    feature = Skeleton(data.shaped.joints, data.shaped.body.parents).pose(bent.pose).feature
    offset = np.linalg.norm(posedirs @ feature, axis=1)
    assert moved.max() > 0.01
    assert (moved <= offset + 1e-6).all() and moved[:200].mean() > 0.7 * offset[:200].mean()
    assert (moved[200:] < 1e-12).all()
    kept = body.vertices(bent, len(DETAILS) - 1, causes)
    assert np.array_equal(kept, body.vertices(bent, None, NOTHING))


def test_the_gpu_s_blend_shapes_are_off_by_float16_s_rounding(bent: Any, posedirs: Any) -> None:
    """A number's float16 is off by at most 2^-11 of it, or half of the least subnormal."""
    data = body_data(posedirs)
    body = RunBody(data, on_cpu=False)
    exact, rounded = (body.vertices(bent, 0, causes) for causes in (NOTHING, frozenset({Cause.BLEND})))
    feature = Skeleton(data.shaped.joints, data.shaped.body.parents).pose(bent.pose).feature
    bound = np.linalg.norm((np.abs(posedirs) * 2.0**-11 + 2.0**-25) @ np.abs(feature), axis=1)
    moved = np.linalg.norm(rounded - exact, axis=1)
    assert moved.max() > 1e-7 and (moved[:200] <= bound[:200]).all() and (moved[200:] < 1e-12).all()
    float32 = body.vertices(bent, 0, BODY) - rounded
    assert 0 < np.abs(float32).max() < 1e-5


def test_the_network_as_written_is_the_runtime_s_but_for_ties() -> None:
    """Bytes in, bytes out: a runtime that computes in integers is a step off where a sum lies between two."""
    network = reshaped(check_network(net(), "net"), 32, 32)
    bytes_in = np.random.default_rng(4).integers(0, 256, (32, 32, 3), dtype=np.uint8)
    own = as_written(network)((bytes_in - 7.0) * 0.5) * 255
    session = onnxruntime.InferenceSession(network.model.SerializeToString(), providers=["CPUExecutionProvider"])
    integer = session.run(None, {"bytes": bytes_in[None]})[0][0]
    assert np.abs(own - integer).max() <= 1.001 and (np.abs(own - integer) < 0.01).mean() > 0.95
    half_a_step = as_written(network)((bytes_in - 7.0) * 0.5 + 0.2)
    assert not np.array_equal(half_a_step * 255, own)  # real numbers between the bytes are taken as they are


def test_a_difference_is_shown_as_large_as_the_bar_allows() -> None:
    picture, reference = np.full((40, 60, 3), 0.5), np.full((40, 60, 3), 0.5)
    assert error_by_cause.shown_factor(np.zeros((4, 4))) == 1
    picture[10:20, 20:40] += 0.03
    assert error_by_cause.shown_factor(np.abs(picture - reference).mean(axis=2)) == 32
    assert error_by_cause.shown_factor(np.full((4, 4), 1e-9)) == error_by_cause.LARGEST_FACTOR
    assert error_by_cause.shown_factor(np.ones((4, 4))) == 1
    sheet = error_by_cause.heat_map("title", picture, reference)
    times = -(-error_by_cause.LEAST_SIDE_PX // 60)
    top, left = 2 * error_by_cause.LINE_PX, error_by_cause.BORDER_PX
    assert sheet[top + 15 * times, left + 30 * times].tolist() == [135] * 3  # 0.53
    across = 60 * times + error_by_cause.BORDER_PX
    assert sheet[top + 15 * times, left + across + 30 * times].tolist() == [128] * 3
    shown, nothing = (sheet[top + row * times, left + 2 * across + 30 * times] for row in (15, 5))
    assert shown.tolist() == error_by_cause.coloured(np.array(0.96)).tolist()
    assert nothing.tolist() == error_by_cause.COLOURS[0].tolist()


def test_the_bar_runs_from_its_first_to_its_last_colour(tmp_path: Path) -> None:
    found = error_by_cause.coloured(np.array([0, 0.25, 0.5, 0.125, 1, 7]))
    assert found[[0, 1, 2, 4]].tolist() == error_by_cause.COLOURS[[0, 1, 2, 4]].tolist()
    assert found[3].tolist() == [44, 8, 57] and found[5].tolist() == found[4].tolist()
    file = tmp_path / "map.png"
    error_by_cause.write_heat_map(file, "t", np.zeros((8, 8, 3)), np.ones((8, 8, 3)))
    with Image.open(file) as image:
        assert image.size[0] > 3 * 320


def test_frames_with_nobody_in_view_have_no_figures(monkeypatch: pytest.MonkeyPatch) -> None:
    """Else the run would be said to be without an error, 100 dB."""
    empty = SimpleNamespace(output=OUTPUT, moment=lambda _: SimpleNamespace(boxes=()))
    monkeypatch.setattr(error_by_cause, "ReferencePath", lambda _: empty)
    monkeypatch.setattr(error_by_cause, "_truth", lambda _: None)
    checked: Any = SimpleNamespace(config=SimpleNamespace(scene=SimpleNamespace(frames=9, name="away")))
    with pytest.raises(BadInputError, match="scene away: found nobody in view in any of the frames"):
        error_by_cause.error_by_cause(checked, 2)
