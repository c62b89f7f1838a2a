"""`python -m trilane.training.train`: render, train, quantise, validate and write an avatar in one go.

Rule: everything a run depends on is in `TrainConfig`, and the command that was run is written into the bundle.
"""

from __future__ import annotations

import argparse
import json
import os
import shlex
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from PIL import Image

from trilane.avatars.bundle import OFFSETS, bundle_folder, load_bundle
from trilane.avatars.manifest import Validation
from trilane.body.body import ShapedBody
from trilane.errors import BadInputError, TrilaneError
from trilane.training.body_arrays import body_arrays
from trilane.training.capture.capture_samples import CaptureRenderer
from trilane.training.capture_error import error_facts, frame_errors, write_held_out_error
from trilane.training.clothing.looks import DEFAULT_NAME
from trilane.training.comparison_sheet import comparison_sheet
from trilane.training.dataset import plan_training, write_dataset
from trilane.training.evaluate import Evaluated
from trilane.training.first_texture import first_texture
from trilane.training.float_painter import float_painter
from trilane.training.from_integers import network_of
from trilane.training.make_bundle import quantise_avatar, write_avatar
from trilane.training.network import UNet
from trilane.training.neural_texture import SIDES, NeuralTexture
from trilane.training.outlines import subject_with_offsets
from trilane.training.rounding import keep_rounded_weights
from trilane.training.sample_files import open_groups
from trilane.training.sample_renderer import SampleRenderer
from trilane.training.subject import Subject, captured_subject, clothed_subject
from trilane.training.trainable_avatar import Precision, TrainableAvatar
from trilane.training.training_loop import FitConfig, fit
from trilane.training.validate import (
    BUILTIN_HELD_OUT,
    FLOAT,
    PER_BAND,
    SEEDS,
    FloatNetwork,
    ValidationPlan,
    held_out_motions,
    revalidate,
    validate,
)
from trilane.training.weights_file import load_avatar, load_network, save_avatar, save_network

CHANNELS = 16
CHECKPOINT, FINAL, NETWORK = "checkpoint.npz", "final.npz", "network.npz"
FACTS, TRAINING = "dataset.json", "training"
#: Settings of `FitConfig` for a training that starts from a network, and for one that also has a trained texture.
#: What the loop is told as the command is.
SHARED = ("minutes", "workers", "threads", "batch", "seed", "precision", "bytes_from")
REPEATS = (2, 1, 2, 3, 1)
KNOWN_NETWORK: dict[str, Any] = {"small_until": 0.0, "freeze_norms_at": 0.3, "repeats": REPEATS}
RESUMED: dict[str, Any] = {
    "network_rate": 1e-3,
    "texture_rate": 3e-4,
    "small_until": 0.0,
    "freeze_norms_at": 0.1,
    "repeats": REPEATS,
}


@dataclass(frozen=True)
class TrainConfig:
    """One training run.

    `body`: the body file. `out`: folder of the bundle. `name`: of the avatar. `work`: folder of data set and weights.
    `sheet`: picture file that compares held-out samples; None for none.
    `minutes`: of training. `samples`: of the training set. `per_band`: validation samples of each band and seed.
    `held_out`: motions that validation poses come from. `width`: of the network; 64 is full.
    `capture`: folder of the person to train on; None for the body in `body`, clothed. `look`: of that body, a name of
    `LOOKS`.
    `precision`: of the network while it is trained; "bfloat16" is three times as fast on processors with AMX.
    `bytes_from`: share of the minutes after which weights and activations are rounded as the bundle's are.
    `weights`: do not train, use these. `resume`: continue from these weights at a lower rate. `network`: start from the
    network of these weights or, with the name or folder of an avatar, from that of its integers; with a new texture or
    with `texture`, that of a trained avatar (a name or a folder).
    """

    body: Path = bundle_folder("default") / "body.npz"
    out: Path = Path("avatar")
    name: str = "default"
    work: Path = Path("avatar-work")
    sheet: Path | None = None
    minutes: float = 60.0
    samples: int = 4000
    per_band: int = PER_BAND
    held_out: tuple[str, ...] = (BUILTIN_HELD_OUT,)
    width: int = 16
    workers: int = 3
    threads: int = 1
    batch: int = 4
    seed: int = 1
    weights: Path | None = None
    resume: Path | None = None
    network: Path | None = None
    texture: str | None = None
    capture: Path | None = None
    look: str | None = None
    precision: Precision = "float32"
    bytes_from: float = 1.0


def train(config: TrainConfig, report: Callable[[str], None]) -> Path:
    """Run `config` and return the bundle's folder; `report` takes lines of progress.

    Raises BadInputError for inputs that do not fit together, MissingPartError without OpenGL.
    """
    torch.manual_seed(config.seed)
    config.work.mkdir(parents=True, exist_ok=True)
    subject = subject_with_offsets(_subject(config, report), config.work / OFFSETS, config.seed, report)
    held_out_motions(config.held_out)  # a motion that cannot be read ends the command here
    _render_training_set(subject, config, report)
    shaped = subject.shaped
    avatar, steps = _trained(shaped, config, report)
    report("quantising and evaluating")
    torch.set_num_threads(config.workers)
    if config.bytes_from < 1:
        keep_rounded_weights(avatar, open_groups(config.work / TRAINING), config.seed)
        save_network(avatar, config.work / NETWORK)
    groups = open_groups(config.work / TRAINING)
    quantised = quantise_avatar(avatar, shaped, groups, config.seed, subject.unseen)
    names = {"name": config.name, "training_command": command_of(config)}
    provenance = _provenance(config, steps) | subject.facts
    write_avatar(config.out, subject.person, quantised, config.width, provenance, names)
    if subject.truth is not None:
        validation = _validate(config, avatar, subject.truth)
        report(validation.model_dump_json())
    if subject.frames is not None:
        report(json.dumps({"held_out_error": _measure_held_out(config, subject.frames, subject.held_out)}))
    return config.out


def _subject(config: TrainConfig, report: Callable[[str], None]) -> Subject:
    if config.capture is None:
        return clothed_subject(config.body, config.workers, config.look or DEFAULT_NAME)
    if config.look is not None:
        raise BadInputError("--look", repr(config.look), "none beside --capture, which has a person of its own")
    return captured_subject(config.capture, config.workers, report)


def _measure_held_out(config: TrainConfig, renderer: CaptureRenderer, numbers: Sequence[int]) -> dict[str, Any]:
    """The error on frames of the capture that training never read, which is written into the bundle."""
    bundle = load_bundle(config.out)
    facts = error_facts(frame_errors(bundle, renderer, numbers, config.workers))
    write_held_out_error(bundle, facts)
    return facts


def _validate(config: TrainConfig, avatar: TrainableAvatar, renderer: SampleRenderer) -> Validation:
    """Validate the bundle that was written, beside the float weights that it was made of."""
    bundle, samples = load_bundle(config.out), list[Evaluated]()
    plan = ValidationPlan(config.held_out, SEEDS, config.per_band, threads=config.workers)
    paint = float_painter(avatar.network, avatar.texture.image().detach())

    def keep(seed: int, sample: Evaluated) -> None:
        if seed == plan.seeds[0]:
            samples.append(sample)

    validation = validate(bundle, plan, renderer, FloatNetwork("the trained weights", paint), keep)
    revalidate(bundle, validation)
    if config.sheet is not None:
        Image.fromarray(comparison_sheet(samples, (FLOAT, *plan.runtimes))).save(config.sheet)
    return validation


def _provenance(config: TrainConfig, steps: int) -> dict[str, Any]:
    return {
        "samples": config.samples,
        "steps": steps,
        "batch": config.batch,
        "seed": config.seed,
        "held_out_motions": [Path(name).name for name in config.held_out],
        "texture_sides": list(SIDES),
    }


def command_of(config: TrainConfig) -> str:
    """The command line of `config` without folders: motions and weights are written by their file names alone."""
    options: list[str] = []
    for field in fields(TrainConfig):
        value = getattr(config, field.name)
        if isinstance(value, tuple):
            options += [part for motion in value for part in ("--held-out", Path(motion).name)]
        elif field.name in ("weights", "resume", "network", "capture") and value is not None:
            options += [f"--{field.name}", value.name]
        elif isinstance(value, int | float | str):
            options += [f"--{field.name.replace('_', '-')}", str(value)]
    return shlex.join(["python", "-m", "trilane.training.train", *options])


def _render_training_set(subject: Subject, config: TrainConfig, report: Callable[[str], None]) -> None:
    """Render the training set into the work folder, unless it is there. Raises BadInputError for another set's."""
    facts, folder = config.work / FACTS, config.work / TRAINING
    wanted: dict[str, Any] = {"samples": config.samples, "seed": config.seed}
    if config.capture is not None:
        wanted |= {"capture": str(config.capture.resolve())}
    elif config.look is not None:
        wanted |= {"look": config.look}
    if facts.exists():
        present = json.loads(facts.read_text())
        if present != wanted:
            raise BadInputError(facts, str(present), str(wanted), "use another --work folder")
        return
    report(f"rendering {config.samples} samples into {folder}")
    samples = plan_training(subject.renderer, config.samples, config.seed)
    write_dataset(subject.source, samples, folder, config.workers)
    facts.write_text(json.dumps(wanted))


def _trained(shaped: ShapedBody, config: TrainConfig, report: Callable[[str], None]) -> tuple[TrainableAvatar, int]:
    """The trained avatar and its number of steps; with `config.weights`, those weights as they are."""
    if config.weights is not None:
        return load_avatar(_blank_avatar(config), config.weights)
    avatar, steps_before, settings = _starting_point(shaped, config)

    def checkpoint(avatar: TrainableAvatar, steps: int) -> None:
        save_avatar(avatar, steps_before + steps, config.work / CHECKPOINT)

    avatar, steps = fit(avatar, config.work / TRAINING, settings, report, checkpoint)
    save_avatar(avatar, steps_before + steps, config.work / FINAL)
    save_network(avatar, config.work / NETWORK)
    return avatar, steps_before + steps


def _starting_point(shaped: ShapedBody, config: TrainConfig) -> tuple[TrainableAvatar, int, FitConfig]:
    """The avatar that training starts from, the steps it has been trained, and the settings of the training."""
    shared = {name: getattr(config, name) for name in SHARED}
    settings = FitConfig(**shared)
    if config.resume is not None:
        avatar, steps = load_avatar(_blank_avatar(config), config.resume)
        return avatar, steps, replace(settings, **RESUMED, seed=config.seed + config.workers)
    network = _new_network(config)
    texture = _first_texture(shaped, config)
    if config.network is not None:
        settings = replace(settings, **(RESUMED if config.texture else KNOWN_NETWORK))
        network = _known_network(network, config)
    return TrainableAvatar(NeuralTexture(texture), network), 0, settings


def _new_network(config: TrainConfig) -> UNet:
    return UNet(width=config.width, channels=CHANNELS, input_skip=True)


def _known_network(blank: UNet, config: TrainConfig) -> UNet:
    """The network of `config.network`: weights for `blank`, or an avatar."""
    assert config.network is not None
    if config.network.suffix == ".npz":
        return load_network(blank, config.network)
    return network_of(load_bundle(config.network), open_groups(config.work / TRAINING), config.seed)


def _blank_avatar(config: TrainConfig) -> TrainableAvatar:
    """An avatar of the right shapes, for weights to be loaded into."""
    network = _new_network(config)
    return TrainableAvatar(NeuralTexture(np.zeros((SIDES[0], SIDES[0], CHANNELS), np.float32)), network)


def _first_texture(shaped: ShapedBody, config: TrainConfig) -> NDArray[np.float32]:
    if config.texture is None:
        return first_texture(body_arrays(shaped), open_groups(config.work / TRAINING), SIDES[0], CHANNELS)
    texture = load_bundle(config.texture).read_texture()
    if texture.shape != (SIDES[0], SIDES[0], CHANNELS):
        raise BadInputError("--texture", f"shape {texture.shape}", f"({SIDES[0]}, {SIDES[0]}, {CHANNELS})")
    return texture


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="python -m trilane.training.train", description=__doc__)
    for field in fields(TrainConfig):
        default = field.default
        if isinstance(default, tuple):
            parser.add_argument("--held-out", action="append", help=f"motion for validation (default {default[0]})")
        else:
            is_path = "Path" in str(field.type)
            kind = Path if is_path else str if default is None else type(default)
            parser.add_argument(f"--{field.name.replace('_', '-')}", type=kind, default=default, help=f"({default})")
    return parser


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line `arguments`, the process's own by default, and return the exit code."""
    values = vars(_parser().parse_args(sys.argv[1:] if arguments is None else list(arguments)))
    values["held_out"] = tuple(values["held_out"] or (BUILTIN_HELD_OUT,))
    started = time.monotonic()

    def report(line: str) -> None:
        print(f"{time.monotonic() - started:7.0f} s  {line}", file=sys.stderr)

    try:
        folder = train(TrainConfig(**values), report)
    except TrilaneError as error:
        print(error, *error.details, sep="\n", file=sys.stderr)
        return error.exit_code
    print(os.fspath(folder))
    return 0


if __name__ == "__main__":
    sys.exit(main())
