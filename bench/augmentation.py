"""What is a close-up worth when views are drawn by the camera, and what when whole frames are resampled?

Rule: one capture, the same views, first network, first texture's method, steps and batches; only how a view is made of
its frame differs. The body wears what the package's avatar of that look wears, so that outlines are not what is
compared. Both avatars are measured on motions, cameras and seeds that no training sample has.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any

import numpy as np

from trilane import machine
from trilane.avatars.bundle import bundle_folder, load_bundle
from trilane.body.body import load_body
from trilane.errors import BadInputError, MissingPartError
from trilane.figure_sources import MEASURED
from trilane.training.clothing.looks import look_named

if TYPE_CHECKING:
    from trilane.body.body import ShapedBody
    from trilane.training.capture.capture import Capture
    from trilane.training.sample_renderer import SampleRenderer
    from trilane.training.validate import Painter

FRAME = (720, 1280)
CAMERA, IMAGE = "camera space", "image space"
#: What the default network has in its texture.
CHANNELS = 16
MOST_STEPS = 100_000


@dataclass(frozen=True)
class _Work:
    """What both trainings share. `count`: of samples. `seed`: of all random numbers."""

    capture: Capture
    steps: int
    count: int
    seed: int


def measure(
    steps: int = 200, frames: int = 32, samples: int = 320, views: int = 12, look: str = "hiker", seed: int = 1
) -> dict[str, Any]:
    """Avatars of a synthetic person, trained by `steps` steps of four views with either augmentation.

    Keys: `rows`, one per augmentation: `psnr_db_far`, `psnr_db_full_body`, `psnr_db_upper_body`, `psnr_db_face` and
    `iou` (the float network on `views` held-out views of each band), `loss` (mean of the last tenth of the steps);
    `gain_db`, of camera space over image space by band; `sources`; `config`.

    Raises BadInputError, MissingPartError.
    """
    if not 10 <= steps <= MOST_STEPS:
        raise BadInputError("--steps", str(steps), f"10 to {MOST_STEPS}")
    if samples < 8:
        raise BadInputError("--samples", str(samples), "at least 8")
    if frames < 4:
        raise BadInputError("--frames", str(frames), "at least 4")
    chosen = look_named(look)
    for part in ("torch", "skimage"):
        if not machine.here.has_package(part):
            raise MissingPartError(f"training needs {part}", extra="train")
    from trilane.training.sample_renderer import SampleRenderer

    offsets = load_bundle(look).read_body().offsets
    bare = load_body(bundle_folder("default") / "body.npz").shape(chosen.betas)
    shaped = bare if offsets is None else bare.with_offsets(offsets)
    rows = list[dict[str, Any]]()
    with TemporaryDirectory() as folder:
        capture = _capture(Path(folder) / "capture", shaped, frames, look, seed)
        work = _Work(replace(capture, shaped=shaped), steps, samples, seed)
        studio = SampleRenderer(shaped, threads=1, look=chosen)
        for name, source in _sources(work.capture).items():
            paint, loss = _trained(work, source, Path(folder) / name.replace(" ", "-"))
            rows.append({"augmentation": name, **_errors(studio, paint, views, seed), "loss": loss})
    gains = {key.removeprefix("psnr_db_"): rows[0][key] - rows[1][key] for key in rows[0] if key.startswith("psnr_db")}
    config = {"steps": steps, "frames": frames, "samples": samples, "views": views, "look": look, "seed": seed}
    return {"rows": rows, "gain_db": gains, "sources": {"rows": MEASURED, "gain_db": MEASURED}, "config": config}


def _capture(folder: Path, shaped: ShapedBody, frames: int, look: str, seed: int) -> Capture:
    """A capture of the synthetic person, without noise."""
    from trilane.training.capture.capture import open_capture
    from trilane.training.capture.synthetic import Recipe, SyntheticCapture, write_capture

    recipe = Recipe(frames, FRAME, seed, look=look)
    folder.mkdir()
    for _ in write_capture(folder, SyntheticCapture(shaped, recipe), recipe):
        pass
    return open_capture(folder)


def _sources(capture: Capture) -> dict[str, Callable[[], Any]]:
    """What opens the renderer of each augmentation, also in another process."""
    return {CAMERA: partial(open_source, capture, False), IMAGE: partial(open_source, capture, True)}


def open_source(capture: Capture, resamples: bool) -> Any:
    """The renderer of samples of all frames. `resamples`: image-space augmentation. Raises MissingPartError."""
    from trilane.bench.lib.image_space import ImageSpaceRenderer
    from trilane.training.capture.capture_samples import CaptureRenderer, ViewRule

    renderer = CaptureRenderer(capture, range(len(capture)), ViewRule(), threads=1)
    return ImageSpaceRenderer(renderer) if resamples else renderer


def _trained(work: _Work, source: Callable[[], Any], folder: Path) -> tuple[Painter, float]:
    """The painter of the avatar that was trained on samples of `source`, and the last loss."""
    import torch

    from trilane.training.dataset import plan_training, write_dataset
    from trilane.training.first_texture import first_texture
    from trilane.training.network import UNet
    from trilane.training.sample_files import open_groups
    from trilane.training.step_loop import first_state, steps
    from trilane.training.surface import body_arrays
    from trilane.training.train import DEFAULT_NETWORK
    from trilane.training.trainable_avatar import SIDES, NeuralTexture, TrainableAvatar, float_painter, load_network
    from trilane.training.training_settings import parsed_settings

    settings = parsed_settings({"seed": work.seed}, "bench augmentation")
    torch.set_num_threads(settings.threads)
    torch.manual_seed(work.seed)
    write_dataset(source, plan_training(source(), work.count, work.seed), folder, 1)
    groups = open_groups(folder)
    texture = first_texture(body_arrays(work.capture.shaped), groups, SIDES[0], CHANNELS)
    network = load_network(UNet(width=settings.width, channels=CHANNELS, input_skip=True), DEFAULT_NETWORK)
    state = first_state(TrainableAvatar(NeuralTexture(texture), network), settings)
    weights = settings.loss.by_name()
    losses = [
        sum(weights.get(name, 0.0) * value for name, value in terms.items())
        for terms in steps(state, groups, settings, work.steps)
    ]
    avatar = state.average
    paint = float_painter(avatar.network, avatar.texture.image().detach())
    return paint, float(np.mean(losses[-max(1, len(losses) // 10) :]))


def _errors(studio: SampleRenderer, paint: Painter, views: int, seed: int) -> dict[str, float]:
    """PSNR by band, and IoU, of what is painted of held-out poses in held-out views."""
    from trilane.training.dataset import plan_validation
    from trilane.training.image_error import SampleError, summary
    from trilane.training.validate import BUILTIN_HELD_OUT, FLOAT, evaluate, held_out_motions

    planned = plan_validation(studio, views, seed, held_out_motions([BUILTIN_HELD_OUT]))
    with studio.ctx:  # the trainings opened contexts of their own
        errors = [
            SampleError(seed, sample.number, sample.band, sample.errors[FLOAT])
            for sample in evaluate(studio, planned, {FLOAT: paint})
        ]
    figures = summary(errors)
    return {f"psnr_db_{band}": value for band, value in figures["psnr_db_by_band"].items()} | {"iou": figures["iou"]}
