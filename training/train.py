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

from trilane.avatars.bundle import bundle_folder, load_bundle
from trilane.body.body import ShapedBody, load_body
from trilane.errors import BadInputError, TrilaneError
from trilane.scene.motion.load import load_motion
from trilane.scene.schema import AvatarSpec
from trilane.training.data import open_groups
from trilane.training.dataset import Sample, Studio, body_arrays, plan_training, plan_validation, write_dataset
from trilane.training.finish import finish, write_avatar
from trilane.training.fit import Avatar, FitConfig, fit, load_avatar, load_network, save_avatar, save_network
from trilane.training.network import UNet
from trilane.training.start import first_texture
from trilane.training.texture import SIDES, NeuralTexture

CHANNELS = 16
CHECKPOINT, FINAL, NETWORK = "checkpoint.npz", "final.npz", "network.npz"
FACTS, TRAINING = "dataset.json", "training"
BUILTIN_HELD_OUT = "builtin:walk-wave-turn"
#: Of `FitConfig`, for a training that does not begin with nothing.
KNOWN_NETWORK: dict[str, Any] = {"small_until": 0.0, "freeze_norms_at": 0.3}
RESUMED: dict[str, Any] = {
    "network_rate": 6e-4,
    "texture_rate": 2e-4,
    "small_until": 0.0,
    "freeze_norms_at": 0.1,
    "repeats": (2, 1, 2, 3, 1),
}


@dataclass(frozen=True)
class TrainConfig:
    """One training run. `held_out`: motions that validation poses come from. `weights`: skip training, use
    these. `resume`: go on from these at a lower rate. `network`: take the network from these, the texture anew, or
    with `texture` from that avatar (a name or a folder), and go on at the lower rate too.
    """

    body: Path = bundle_folder("default") / "body.npz"
    out: Path = Path("avatar")
    name: str = "default"
    work: Path = Path("avatar-work")
    sheet: Path | None = None
    minutes: float = 60.0
    samples: int = 4000
    per_band: int = 24
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


def train(config: TrainConfig, report: Callable[[str], None]) -> Path:
    """Run `config` and return the bundle's folder. Raises BadInputError for inputs that do not fit."""
    torch.manual_seed(config.seed)
    shaped = load_body(config.body).shape()
    studio = Studio(shaped, threads=config.workers)
    held_out = held_out_samples(studio, config)
    _render(studio, config, report)
    avatar, steps = _fitted(shaped, config, report)
    report("quantising and judging")
    torch.set_num_threads(config.workers)
    groups = open_groups(config.work / TRAINING)
    done, made, texture, scale = finish(avatar, studio, shaped, groups, held_out, config.seed, config.workers)
    facts = {
        "body": "the default body, dressed by trilane.training.clothing",
        "samples": config.samples,
        "steps": steps,
        "batch": config.batch,
        "seed": config.seed,
        "held_out_motions": [Path(name).name for name in config.held_out],
        "texture_sides": list(SIDES),
    }
    names = {"name": config.name, "training_command": command_of(config)}
    write_avatar(config.out, config.body, done, made, texture, scale, config.width, facts, names)
    if config.sheet is not None:
        Image.fromarray(done.sheet).save(config.sheet, optimize=True)
    report(json.dumps({"float": done.float_figures, "integer": done.integer_figures}))
    return config.out


def command_of(config: TrainConfig) -> str:
    """The command line of `config`, places left out: of motions and of weights to start from only the name stays."""
    options: list[str] = []
    for field in fields(TrainConfig):
        value = getattr(config, field.name)
        if isinstance(value, tuple):
            options += [part for motion in value for part in ("--held-out", Path(motion).name)]
        elif field.name in ("weights", "resume", "network") and value is not None:
            options += [f"--{field.name}", value.name]
        elif isinstance(value, int | float | str):
            options += [f"--{field.name.replace('_', '-')}", str(value)]
    return shlex.join(["python", "-m", "trilane.training.train", *options])


def held_out_samples(studio: Studio, config: TrainConfig) -> list[Sample]:
    """The validation samples of `config`, the same every time."""
    motions = [load_motion(AvatarSpec(motion=name), Path.cwd()) for name in config.held_out]
    return plan_validation(studio, config.per_band, config.seed, motions)


def _render(studio: Studio, config: TrainConfig, report: Callable[[str], None]) -> None:
    facts, folder = config.work / FACTS, config.work / TRAINING
    wanted = {"samples": config.samples, "seed": config.seed}
    if facts.exists():
        found = json.loads(facts.read_text())
        if found != wanted:
            raise BadInputError(facts, str(found), str(wanted), "use another --work folder")
        return
    report(f"rendering {config.samples} samples into {folder}")
    samples = plan_training(studio, config.samples, config.seed)
    write_dataset(config.body, samples, folder, config.workers)
    facts.write_text(json.dumps(wanted))


def _fitted(shaped: ShapedBody, config: TrainConfig, report: Callable[[str], None]) -> tuple[Avatar, int]:
    blank = np.zeros((SIDES[0], SIDES[0], CHANNELS), np.float32)
    network = UNet(width=config.width, channels=CHANNELS, input_skip=True)
    if config.weights is not None:
        return load_avatar(Avatar(NeuralTexture(blank), network), config.weights)
    shared = {name: getattr(config, name) for name in ("minutes", "workers", "threads", "batch", "seed")}
    settings = FitConfig(**shared)
    done = 0
    if config.resume is not None:
        settings = replace(settings, **RESUMED, seed=config.seed + config.workers)
        avatar, done = load_avatar(Avatar(NeuralTexture(blank), network), config.resume)
    else:
        start = _start(shaped, config)
        if config.network is not None:
            settings = replace(settings, **(RESUMED if config.texture else KNOWN_NETWORK))
            network = load_network(network, config.network)
        avatar = Avatar(NeuralTexture(start), network)

    def checkpoint(avatar: Avatar, steps: int) -> None:
        save_avatar(avatar, done + steps, config.work / CHECKPOINT)

    avatar, steps = fit(avatar, config.work / TRAINING, settings, report, checkpoint)
    save_avatar(avatar, done + steps, config.work / FINAL)
    save_network(avatar, config.work / NETWORK)
    return avatar, done + steps


def _start(shaped: ShapedBody, config: TrainConfig) -> NDArray[np.float32]:
    if config.texture is None:
        return first_texture(body_arrays(shaped), open_groups(config.work / TRAINING), SIDES[0], CHANNELS)
    texture = load_bundle(config.texture).read_texture()
    if texture.shape != (SIDES[0], SIDES[0], CHANNELS):
        raise BadInputError("--texture", f"shape {texture.shape}", f"({SIDES[0]}, {SIDES[0]}, {CHANNELS})")
    return texture


def main(arguments: Sequence[str] | None = None) -> int:
    """Parse the command line, run, and return the exit code."""
    given = sys.argv[1:] if arguments is None else list(arguments)
    parser = argparse.ArgumentParser(prog="python -m trilane.training.train", description=__doc__)
    for field in fields(TrainConfig):
        default = field.default
        if isinstance(default, tuple):
            parser.add_argument("--held-out", action="append", help=f"motion for validation (default {default[0]})")
        else:
            named = "Path" in str(field.type)
            kind = Path if named else str if default is None else type(default)
            parser.add_argument(f"--{field.name.replace('_', '-')}", type=kind, default=default, help=f"({default})")
    values = vars(parser.parse_args(given))
    values["held_out"] = tuple(values["held_out"] or (BUILTIN_HELD_OUT,))
    started = time.monotonic()

    def report(line: str) -> None:
        print(f"{time.monotonic() - started:7.0f} s  {line}", file=sys.stderr, flush=True)

    try:
        folder = train(TrainConfig(**values), report)
    except TrilaneError as error:
        print(error, file=sys.stderr)
        return error.exit_code
    print(os.fspath(folder))
    return 0


if __name__ == "__main__":
    sys.exit(main())
