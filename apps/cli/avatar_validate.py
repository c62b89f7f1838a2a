"""`trilane avatar validate`: how good an avatar is on views that it was not trained on, measured anew.

Rule: this file talks to the person; the work is done in `trilane.training.validate`.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from trilane.apps.cli.console import print_facts, stderr_console, stdout_console, stdout_kept
from trilane.apps.cli.options import AvatarArgument, JsonOption
from trilane.avatars.manifest import BANDS, CAPTURED
from trilane.errors import BadInputError, MissingPartError
from trilane.figure_sources import from_validation
from trilane.stages.run_options import SIZE_HELP

if TYPE_CHECKING:
    from rich.table import Table

    from trilane.avatars.bundle import Bundle
    from trilane.avatars.manifest import Validation
    from trilane.training.validate import Evaluated, FloatNetwork, ValidationPlan

EPILOG_VALIDATE = """\b
Examples:
  trilane avatar validate my-avatar
  trilane avatar validate my-avatar --held-out builtin:walk-wave-turn --held-out jump.bvh --runtime openvino
  trilane avatar validate default --seed 1 --seed 2 --sheet worst.png
  trilane avatar validate my-avatar --sizes
"""
#: Runtimes that are validated when none is given, where they are installed; the first one's figures are the avatar's.
RUNTIMES = ("ort", "openvino")


def validate(
    name: AvatarArgument,
    held_out: Annotated[
        list[str] | None,
        typer.Option(help="Motion that no training had: builtin:NAME or a file. Repeat it; walk-wave-turn if none."),
    ] = None,
    seed: Annotated[
        list[int] | None, typer.Option(min=0, help="Seed of views and poses. Repeat it; 1 to 8 if none.")
    ] = None,
    per_band: Annotated[int, typer.Option(min=1, max=1000, help="Views of each band for each seed.")] = 24,
    runtime: Annotated[
        list[str] | None,
        typer.Option(help="ort, openvino, qnn or cuda. Repeat it; ort, and openvino where installed, if none."),
    ] = None,
    size: Annotated[str, typer.Option(help=SIZE_HELP)] = "256",
    float_network: Annotated[
        Path | None, typer.Option(help="Weights before quantising (.npz), to say what quantising costs.")
    ] = None,
    sheet: Annotated[
        Path | None, typer.Option(help="Write a picture: the worst view of each seed beside its ground truth.")
    ] = None,
    sizes: Annotated[
        bool, typer.Option("--sizes", help="Only measure what smaller tensors cost; the other figures stay.")
    ] = False,
    json: JsonOption = False,
) -> None:
    """Measure an avatar's image error on held-out views, and write it into the manifest with digests of the files.

    What the manifest said before is replaced.
    """
    from trilane.apps.made import made_facts
    from trilane.avatars.bundle import load_bundle, require_writable_manifest
    from trilane.avatars.validation import no_truth, validation_facts
    from trilane.shapes import shape_buckets
    from trilane.stages.dsp.runtime import installed, resolve
    from trilane.unexpected_value import UnexpectedValue

    runtimes = [resolve(each) for each in runtime or [each for each in RUNTIMES if each in installed()]]
    try:
        shape_buckets(size)
    except UnexpectedValue as error:
        raise BadInputError.at("--size", error) from error
    bundle = load_bundle(name)
    if bundle.manifest.provenance.get("body") == CAPTURED:
        raise BadInputError(
            bundle.folder, "an avatar of a capture", "one of the default body, clothed", no_truth(bundle)
        )
    try:
        from trilane.training import validate as work
    except ImportError as error:
        raise MissingPartError(f"validating needs {error.name}", extra="metrics") from None
    seeds = tuple(dict.fromkeys(seed)) if seed else work.SEEDS
    require_writable_manifest(bundle.folder)
    made = made_facts(())
    plan = work.ValidationPlan(
        held_out=tuple(held_out or (work.BUILTIN_HELD_OUT,)),
        seeds=seeds,
        per_band=per_band,
        runtimes=tuple(dict.fromkeys(runtimes)),
        size=size,
        revision=made["revision"],
        modified=made["modified"],
    )
    validated = _add_sizes(bundle, plan) if sizes else _validate(bundle, plan, float_network, sheet)
    if not json and validated.manifest.validation is not None:
        stdout_console().print(band_table(validated.manifest.validation))
    print_facts({"name": bundle.manifest.name, "validation": validation_facts(validated)}, json)


def band_table(validation: Validation) -> Table:
    """A row for each band of zoom: what the first runtime's pictures are worth, and what quantising cost."""
    from rich.table import Table

    own = validation.on(validation.runtime) or validation
    cost = (validation.model_extra or {}).get("psnr_loss_db", {})
    columns = {
        "PSNR, dB": (own.psnr_db_by_band, 2),
        "of the person alone": (own.body_psnr_db_by_band or {}, 2),
        "alpha < 0.9 inside, %": ({band: 100 * share for band, share in (own.see_through_by_band or {}).items()}, 2),
        "mask IoU": (own.iou_by_band or {}, 4),
        "lost by quantising, dB": (cost, 2),
    }
    table = Table("band", *columns, caption=from_validation(validation.date))
    for band in own.psnr_db_by_band:
        cells = (f"{by[band]:.{digits}f}" if band in by else "-" for by, digits in columns.values())
        table.add_row(band.replace("_", " "), *cells)
    return table


def _validate(bundle: Bundle, plan: ValidationPlan, float_network: Path | None, sheet: Path | None) -> Bundle:
    """Validate `bundle`, write its manifest and, where asked, the sheet; the bundle as it is then."""
    from rich.progress import Progress

    from trilane.training import validate as work

    beside = _float_network(bundle, float_network) if float_network is not None else None
    worst: dict[int, Evaluated] = {}
    console = stderr_console()
    with stdout_kept(), Progress(console=console, disable=not console.is_terminal) as progress:
        task = progress.add_task("validating", total=len(plan.seeds) * plan.per_band * len(BANDS))

        def look(seed: int, sample: Evaluated) -> None:
            progress.advance(task)
            if seed not in worst or _psnr_db(sample, plan) < _psnr_db(worst[seed], plan):
                worst[seed] = sample

        renderer = work.open_renderer(bundle, plan.threads)
        validated = work.revalidate(bundle, work.validate(bundle, plan, renderer, beside, look))
    if sheet is not None:
        _write_sheet(sheet, list(worst.values()), plan.runtimes[0])
    return validated


def _add_sizes(bundle: Bundle, plan: ValidationPlan) -> Bundle:
    """The figures by size of tensor, written beside those that the manifest of `bundle` has, which must be its own."""
    from rich.progress import Progress

    from trilane.avatars.validation import VALIDATE, name_of, refused
    from trilane.training import validate as work

    validation = bundle.manifest.validation
    if validation is None or (why := refused(bundle)):
        found = "no validation" if validation is None else why["why"]
        command = f"`{VALIDATE} {name_of(bundle.folder)}`"
        raise BadInputError(bundle.folder, found, "an avatar that was validated as it is", f"{command} comes first")
    console = stderr_console()
    with stdout_kept(), Progress(console=console, disable=not console.is_terminal) as progress:
        task = progress.add_task("painting at several sizes", total=plan.per_band * len(BANDS))
        renderer = work.open_renderer(bundle, plan.threads)
        by_size = work.measure_sizes(bundle, plan, renderer, lambda: progress.advance(task))
    return work.revalidate(bundle, work.with_sizes(validation, by_size))


def _psnr_db(sample: Evaluated, plan: ValidationPlan) -> float:
    return sample.errors[plan.runtimes[0]].psnr_db


def _float_network(bundle: Bundle, weights: Path) -> FloatNetwork:
    """The network of the file `weights`. Raises BadInputError, MissingPartError."""
    try:
        from trilane.training.trainable_avatar import float_painter_of
    except ImportError as error:
        raise MissingPartError(f"the float network needs {error.name}", extra="train") from None
    from trilane.bench.lib.full_network import weights_name
    from trilane.training.validate import FloatNetwork

    return FloatNetwork(weights_name(weights), float_painter_of(bundle, weights))


def _write_sheet(path: Path, samples: list[Evaluated], runtime: str) -> None:
    from PIL import Image

    from trilane.training.validate import worst_sheet
    from trilane.writing import write_atomically

    with write_atomically(path) as draft:
        Image.fromarray(worst_sheet(samples, (runtime,))).save(draft, "png", optimize=True)
