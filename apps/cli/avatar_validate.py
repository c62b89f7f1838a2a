"""`trilane avatar validate`: how good an avatar is on views that it was not trained on, measured anew.

Rule: this file talks to the person; the work is done in `trilane.training.validate`.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from trilane.apps.cli.console import print_facts, stderr_console
from trilane.apps.cli.options import SIZE_HELP, AvatarArgument, JsonOption
from trilane.errors import MissingPartError

if TYPE_CHECKING:
    from trilane.avatars.bundle import Bundle
    from trilane.training.evaluate import Evaluated
    from trilane.training.sample_renderer import SampleRenderer
    from trilane.training.validate import FloatNetwork, ValidationPlan

EPILOG_VALIDATE = """\b
Examples:
  trilane avatar validate my-avatar
  trilane avatar validate my-avatar --held-out builtin:walk-wave-turn --held-out jump.bvh --runtime openvino
  trilane avatar validate default --seed 1 --seed 2 --sheet worst.png
"""
#: What stands in the manifest of motions and seeds when none is given.
DEFAULT_SEEDS = "1 to 8"


def validate(
    name: AvatarArgument,
    held_out: Annotated[
        list[str] | None,
        typer.Option(help="Motion that it was not trained on: builtin:NAME or a file. Repeat it; walk-wave-turn if none."),
    ] = None,
    seed: Annotated[
        list[int] | None, typer.Option(min=0, help=f"Seed of views and poses. Repeat it; {DEFAULT_SEEDS} if none.")
    ] = None,
    per_band: Annotated[int, typer.Option(min=1, max=1000, help="Views of each band for each seed.")] = 24,
    runtime: Annotated[
        list[str] | None, typer.Option(help="ort, openvino, qnn or cuda. Repeat it; all that are installed if none.")
    ] = None,
    size: Annotated[str, typer.Option(help=SIZE_HELP)] = "256",
    float_network: Annotated[
        Path | None, typer.Option(help="Weights before quantising (.npz), to say what quantising costs.")
    ] = None,
    sheet: Annotated[
        Path | None, typer.Option(help="Write a picture: the worst view of each seed beside its ground truth.")
    ] = None,
    json: JsonOption = False,
) -> None:
    """Measure an avatar's image error on held-out views, and write it into the manifest with digests of the files."""
    from trilane.avatars.bundle import load_bundle
    from trilane.avatars.validation import validation_facts
    from trilane.stages.dsp.runtime import installed

    plan = _plan(held_out, seed, per_band, tuple(runtime or _ort_first(installed())), size)
    bundle = load_bundle(name)
    validated = _validate(bundle, plan, float_network, sheet)
    print_facts({"name": bundle.manifest.name, "validation": validation_facts(validated)}, json)


def _ort_first(names: object) -> list[str]:
    """The installed runtimes, that which every installation has first: its figures are the avatar's."""
    return sorted((str(name) for name in list(names)), key=lambda name: name != "ort")  # type: ignore[call-overload]


def _plan(
    held_out: list[str] | None, seeds: list[int] | None, per_band: int, runtimes: tuple[str, ...], size: str
) -> ValidationPlan:
    """The plan of the options; what was not given is as in `ValidationPlan`. Raises MissingPartError."""
    try:
        from trilane.training.validate import BUILTIN_HELD_OUT, SEEDS, ValidationPlan
    except ImportError as error:
        raise MissingPartError(f"validating needs {error.name}", extra="metrics") from None
    return ValidationPlan(tuple(held_out or (BUILTIN_HELD_OUT,)), tuple(seeds or SEEDS), per_band, runtimes, size)
