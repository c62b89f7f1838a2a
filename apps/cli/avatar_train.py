"""Commands of `trilane avatar` that train and validate an avatar.

Rule: this file reads options and shows results; `trilane.training.train` and `trilane.training.validate` do the work.
"""

from __future__ import annotations

import time
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from trilane import machine
from trilane.apps.cli.commands import AvatarArgument, JsonOption, given
from trilane.apps.cli.console import print_facts, stderr_console, stdout_console, stdout_kept
from trilane.avatars.manifest import BANDS, CAPTURED
from trilane.avatars.validation import BUILTIN_HELD_OUT, PER_BAND, SEEDS, VALIDATION_RUNTIMES, VALIDATION_SIZE
from trilane.errors import BadInputError, MissingPartError, install_line, package_line
from trilane.stages.run_options import SIZE_HELP
from trilane.units import AVATARS, RUNTIME_WORDS

if TYPE_CHECKING:
    from rich.console import Console
    from rich.progress import Progress
    from rich.table import Table

    from trilane.avatars.bundle import Bundle
    from trilane.avatars.manifest import BySize, Validation
    from trilane.training.validate import Evaluated, FloatNetwork, ValidationPlan

EPILOG_TRAIN = """\b
Examples:
  trilane avatar train my-capture --out mine --minutes 600
  trilane avatar train my-capture --out smoke --minutes 1 --samples 200
  trilane avatar train my-capture --out again --config mine/training.toml
  trilane avatar train my-capture --out mine --network default
  trilane avatar train --out further --config avatars/default/training.toml
"""
#: Package index with PyTorch's builds for the CPU. The default index has the builds for NVIDIA GPUs.
CPU_INDEX = "https://download.pytorch.org/whl/cpu"
#: Weight of the newest loss in the shown running mean; seconds between two lines if stderr is no terminal.
NEWEST, LINE_S = 0.05, 30.0
#: Name of TensorBoard's folder in the work folder; seconds after which logged values are on the disk.
LOG, FLUSH_S = "tensorboard", 10
#: Width of the network of the bundled avatars.
DEFAULT_WIDTH = 16
EPILOG_VALIDATE = """\b
Examples:
  trilane avatar validate my-avatar
  trilane avatar validate my-avatar --held-out builtin:walk-wave-turn --held-out jump.bvh --runtime openvino
  trilane avatar validate default --seed 1 --seed 2 --sheet worst.png
  trilane avatar validate my-avatar --sizes
"""


def train(
    ctx: typer.Context,
    out: Annotated[Path, typer.Option(help="Folder of the avatar to write.")],
    capture: Annotated[
        Path | None, typer.Argument(help="Folder of a capture; none if the settings have a look.")
    ] = None,
    work: Annotated[
        Path | None,
        typer.Option(help="Folder of samples, state and sheets; OUT-work if not given. Training continues from there."),
    ] = None,
    config: Annotated[
        Path | None, typer.Option(help="Settings (training.toml), such as an avatar's own; options override them.")
    ] = None,
    minutes: Annotated[
        float, typer.Option(help="Minutes of training; to draw the samples first takes some more.")
    ] = 60.0,
    steps: Annotated[int | None, typer.Option(help="Number of training steps, in place of a time.")] = None,
    samples: Annotated[int, typer.Option(help="Views of the frames to train on.")] = 4000,
    seed: Annotated[int, typer.Option(help="Seed of all random numbers.")] = 1,
    threads: Annotated[
        int, typer.Option(help="Threads of PyTorch, and drawing processes; only with 1 are the bits the same again.")
    ] = 1,
    device: Annotated[str, typer.Option(help="auto, cpu or cuda; auto is an NVIDIA GPU if there is one.")] = "auto",
    start: Annotated[
        str, typer.Option(help=f"Network to train further: {', '.join(AVATARS)}; new: random weights.")
    ] = "default",
    network: Annotated[
        str | None,
        typer.Option(help="Avatar whose network is kept as it is: only a texture is trained. Replaces --start."),
    ] = None,
    width: Annotated[int, typer.Option(help="Width of a new network; 64 is full.")] = 16,
    loss: Annotated[
        str, typer.Option(help="default: the default avatar's loss; thesis: L1, Dice, perceptual, GAN.")
    ] = "default",
    vgg: Annotated[
        Path | None, typer.Option(help="VGG-16 weights (.pth, .safetensors) for the perceptual loss; else MS-SSIM.")
    ] = None,
    tensorboard: Annotated[bool, typer.Option("--tensorboard", help="Log the losses to WORK/tensorboard too.")] = False,
    json: JsonOption = False,
) -> None:
    """Train an avatar and write it as a folder for `trilane run --avatar`.

    Without a capture, the settings name a look of the default body.

    After an interruption, the same command continues the training where it stopped.
    """
    from trilane.training.training_settings import parsed_settings, read_settings

    usual = {"minutes": minutes, "steps": steps, "samples": samples, "seed": seed, "threads": threads, "start": start}
    options = {
        name: value
        for name, value in (usual | {"width": width, "loss": loss, "device": device}).items()
        if name in given(ctx)
    }
    if network is not None:
        if "start" in options:
            raise BadInputError("--network", network, "none beside --start", "one of both")
        options |= {"start": network, "keep_network": True}
    values = read_settings(config).model_dump(by_alias=True, exclude_none=True) if config is not None else {}
    asked = parsed_settings(values | options, "options" if config is None else config)
    if asked.start != "new" and asked.width != DEFAULT_WIDTH:
        raise BadInputError("--width", str(asked.width), f"{DEFAULT_WIDTH} of a trained network", "or --start new")
    _require_torch()
    from trilane.training.train import TrainingPlaces, train_avatar

    if tensorboard and not machine.here.has_package("tensorboard"):
        raise MissingPartError("a log for TensorBoard needs the package tensorboard", extra="tensorboard")
    work = out.parent / f"{out.name}-work" if work is None else work
    places = TrainingPlaces(capture, out, work, out.name, vgg)
    log = EventLog(work / LOG) if tensorboard else None
    with stdout_kept(), _shown(log) as listener:
        facts = train_avatar(places, asked, listener)
    print_facts(facts, json)


def _require_torch() -> None:
    """Raise MissingPartError if a package that training needs is missing. The error says how to install it."""
    missing = [name for name in ("torch", "scipy", "skimage") if not machine.here.has_package(name)]
    if "torch" in missing:
        lines = f"{package_line('torch')} --index-url {CPU_INDEX} (CPU) or {package_line('torch')} (NVIDIA GPU)"
        raise MissingPartError("training needs torch", f"{lines}, then {install_line('train')}")
    if missing:
        raise MissingPartError(f"training needs {missing[0]}", extra="train")


@contextmanager
def _shown(log: EventLog | None) -> Iterator[_ShownTraining]:
    """Yield a listener that shows the progress of a training on stderr, and writes its losses to `log`.

    A terminal shows bars. Without a terminal, stderr gets lines. `log`: log of losses, closed at the end of the `with`
    block; None for no log.
    """
    from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn

    console = stderr_console()
    columns = (TextColumn("{task.description}"), BarColumn(), TextColumn("{task.completed}/{task.total}"))
    with Progress(*columns, TimeRemainingColumn(), console=console, disable=not console.is_terminal) as progress:
        try:
            yield _ShownTraining(console, progress, log)
        finally:
            if log is not None:
                log.close()


class _ShownTraining:
    """Shows the progress of a training on `console`, as a `trilane.training.train.Listener`.

    `progress`: bars for a terminal. `log`: log for TensorBoard, which gets all losses; None for no log.
    """

    def __init__(self, console: Console, progress: Progress, log: EventLog | None) -> None:
        self._console, self._progress, self._log = console, progress, log
        self._task: Any = None
        self._loss, self._first_step, self._start, self._line = 0.0, 0, 0.0, 0.0

    def say(self, line: str) -> None:
        self._console.print(line, soft_wrap=True)

    def track(self, text: str, numbers: Iterable[Any], total: int) -> Iterable[Any]:
        yield from self._progress.track(numbers, total=total, description=text)

    def trained(self, step: int, total: int, terms: dict[str, float], loss: float) -> None:
        if self._task is None:
            self._task = self._progress.add_task("training", total=total)
            self._loss, self._first_step, self._start = loss, step, time.monotonic()
            self._line = self._start - LINE_S
        if self._log is not None:
            self._log.write(step, terms, loss)
        self._loss += NEWEST * (loss - self._loss)
        shown = f"loss {self._loss:.3f}, composite {terms['composite']:.3f}, overlap {terms['overlap']:.3f}"
        self._progress.update(self._task, completed=step, description=shown)
        now = time.monotonic()
        if self._console.is_terminal or (now - self._line < LINE_S and step < total):
            return
        self._line = now
        left_s = (now - self._start) / max(1, step - self._first_step) * (total - step)
        self.say(f"step {step} of {total}: {shown}" + (f", {left_s:.0f} s left" if step > self._first_step else ""))


class EventLog:
    """Writes the losses of a training into `folder` as a log for TensorBoard.

    The first `write` creates the log's file. If a training continues from a saved state, TensorBoard discards the
    entries of steps after that state.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._writer: Any = None

    def write(self, step: int, terms: Mapping[str, float], loss: float) -> None:
        """Log the loss of the training step `step`.

        `terms`: unweighted terms of the loss, by name. `loss`: their weighted sum.
        """
        if self._writer is None:
            self._writer = _writer(self._folder, step)
        self._writer.add_scalar("loss", loss, step)
        for name, value in terms.items():
            self._writer.add_scalar(f"terms/{name}", value, step)

    def close(self) -> None:
        """Write the entries that are still in TensorBoard's buffer."""
        if self._writer is not None:
            self._writer.close()


def _writer(folder: Path, step: int) -> Any:
    """Return TensorBoard's writer to `folder`. Earlier entries of `step` and of later steps are discarded."""
    from torch.utils.tensorboard import SummaryWriter

    return SummaryWriter(str(folder), purge_step=step, flush_secs=FLUSH_S)


def validate(
    name: AvatarArgument,
    held_out: Annotated[
        list[str] | None,
        typer.Option(
            help=f"Motion that no training used: builtin:NAME or a file. Repeat it; if none, {BUILTIN_HELD_OUT}."
        ),
    ] = None,
    seed: Annotated[
        list[int] | None,
        typer.Option(min=0, help=f"Seed of views and poses. Repeat it; if none, {SEEDS[0]} to {SEEDS[-1]}."),
    ] = None,
    per_band: Annotated[
        int, typer.Option(min=1, max=1000, help="Views of each band of distances, for each seed.")
    ] = PER_BAND,
    runtime: Annotated[
        list[str] | None,
        typer.Option(help=f"{RUNTIME_WORDS}. Repeat it; if none, {', and '.join(VALIDATION_RUNTIMES)} if installed."),
    ] = None,
    size: Annotated[str, typer.Option(help=SIZE_HELP)] = VALIDATION_SIZE,
    float_network: Annotated[
        Path | None, typer.Option(help="Weights before quantising (.npz), to say what quantising costs.")
    ] = None,
    sheet: Annotated[
        Path | None, typer.Option(help="Write a picture: the worst view of each seed beside its ground truth.")
    ] = None,
    sizes: Annotated[
        bool,
        typer.Option("--sizes", help="Measure only the error by size of body and tensor; the rest stays as it is."),
    ] = False,
    json: JsonOption = False,
) -> None:
    """Measure an avatar's image error on held-out views, and write it into the manifest with digests of the files.

    It replaces an earlier validation.
    """
    from trilane.apps.run.report_facts import made_facts
    from trilane.arrays import shape_buckets
    from trilane.avatars.bundle import load_bundle, require_writable_manifest
    from trilane.avatars.validation import no_truth, validation_facts
    from trilane.stages.dsp.runtime import installed, resolve
    from trilane.unexpected_value import UnexpectedValue

    runtimes = [resolve(each) for each in runtime or [each for each in VALIDATION_RUNTIMES if each in installed()]]
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
    require_writable_manifest(bundle.folder)
    made = made_facts(())
    plan = work.ValidationPlan(
        held_out=tuple(held_out or (BUILTIN_HELD_OUT,)),
        seeds=tuple(dict.fromkeys(seed or SEEDS)),
        per_band=per_band,
        runtimes=tuple(dict.fromkeys(runtimes)),
        size=size,
        revision=made["revision"],
        modified=made["modified"],
    )
    validated = _add_sizes(bundle, plan) if sizes else _validate(bundle, plan, float_network, sheet)
    if not json and validated.manifest.validation is not None:
        stdout_console().print(_band_table(validated.manifest.validation))
        if validated.manifest.validation.by_size is not None:
            stdout_console().print(_size_table(validated.manifest.validation.by_size))
    print_facts({"name": bundle.manifest.name, "validation": validation_facts(validated)}, json)


def _band_table(validation: Validation) -> Table:
    """Return a table of image errors with the first runtime, and of PSNR lost by quantising.

    The rows are the bands of distances, from `far` to `face`.
    """
    from rich.table import Table

    from trilane.avatars.validation import from_validation

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


def _size_table(by_size: BySize) -> Table:
    """Return a table of PSNR in dB: a row for each size of the body in the picture, a column for each tensor size.

    Both sizes are squares, given by their sides in pixels.
    """
    from rich.table import Table

    from trilane.avatars.validation import from_validation

    rows = {f"{side}²": row for side, row in (by_size.psnr_db_by_picture or {}).items()}
    tensors = [f"{side}²" for side in next(iter(rows.values()), {})]
    table = Table(
        "picture", *tensors, caption=f"PSNR, dB, by pixels of body and tensor, {from_validation(by_size.date)}"
    )
    for side, row in rows.items():
        table.add_row(side, *(f"{psnr:.1f}" for psnr in row.values()))
    return table


def _validate(bundle: Bundle, plan: ValidationPlan, float_network: Path | None, sheet: Path | None) -> Bundle:
    """Validate `bundle`, write the figures into its manifest, and return the new bundle.

    `plan`: views and runtimes to validate with. `float_network`: file of the weights before quantising, for a
    comparison; None for no comparison. `sheet`: file for a picture of each seed's worst view; None for no picture.
    """
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
    """Measure `bundle` at several tensor sizes, add the figures to its manifest, and return the new bundle.

    `plan`: views and runtime to measure with. Raises BadInputError if the present files of the bundle were not
    validated.
    """
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
    """Return the float network of `bundle`, with the weights in the file `weights`.

    Raises MissingPartError if a package for the network is missing, and BadInputError for wrong weights.
    """
    try:
        from trilane.training.trainable_avatar import float_painter_of
    except ImportError as error:
        raise MissingPartError(f"the float network needs {error.name}", extra="train") from None
    from trilane.bench.lib.full_picture import weights_name
    from trilane.training.validate import FloatNetwork

    return FloatNetwork(weights_name(weights), float_painter_of(bundle, weights))


def _write_sheet(path: Path, samples: list[Evaluated], runtime: str) -> None:
    from PIL import Image

    from trilane.training.validate import worst_sheet
    from trilane.writing import write_atomically

    with write_atomically(path) as draft:
        Image.fromarray(worst_sheet(samples, (runtime,))).save(draft, "png", optimize=True)
