"""`trilane avatar train`: an avatar of a person, from a capture or from settings that say who it is.

Rule: this file talks to the person; the work is done in `trilane.training.train`.
"""

from __future__ import annotations

import time
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from trilane import machine
from trilane.apps.cli.commands import given
from trilane.apps.cli.console import print_facts, stderr_console, stdout_kept
from trilane.apps.cli.options import JsonOption
from trilane.errors import BadInputError, MissingPartError, install_line, package_line

if TYPE_CHECKING:
    from rich.console import Console
    from rich.progress import Progress

EPILOG_TRAIN = """\b
Examples:
  trilane avatar train my-capture --out mine --minutes 600
  trilane avatar train my-capture --out smoke --minutes 1 --samples 200
  trilane avatar train my-capture --out again --config mine/training.toml
  trilane avatar train --out further --config avatars/default/training.toml
"""
#: Where wheels of PyTorch lie that need no GPU; the plain package index has those for NVIDIA's.
CPU_INDEX = "https://download.pytorch.org/whl/cpu"
#: Share of the newest loss in the one that is shown; seconds between two lines where no bar is drawn.
NEWEST, LINE_S = 0.05, 30.0
#: Folder of the log for TensorBoard, in the work folder; seconds after which what was logged is on the disk.
LOG, FLUSH_S = "tensorboard", 10
#: Width of the networks of `default` and `hiker`.
DEFAULT_WIDTH = 16


def train(
    ctx: typer.Context,
    out: Annotated[Path, typer.Option(help="Folder of the avatar to write.")],
    capture: Annotated[
        Path | None, typer.Argument(help="Folder of a capture; none if the settings have a look.")
    ] = None,
    work: Annotated[
        Path | None, typer.Option(help="Folder of samples, state and sheets; OUT-work if none. Training goes on there.")
    ] = None,
    config: Annotated[
        Path | None, typer.Option(help="Settings (training.toml), such as an avatar's own; options go before them.")
    ] = None,
    minutes: Annotated[float, typer.Option(help="Time of training; the samples before it take some more.")] = 60.0,
    steps: Annotated[int | None, typer.Option(help="Steps of training, in place of a time.")] = None,
    samples: Annotated[int, typer.Option(help="Views of the frames to train on.")] = 4000,
    seed: Annotated[int, typer.Option(help="Of all random numbers.")] = 1,
    threads: Annotated[int, typer.Option(help="Of PyTorch, and processes that draw; only 1 repeats to the bit.")] = 1,
    device: Annotated[str, typer.Option(help="auto, cpu or cuda; auto takes an NVIDIA GPU that is there.")] = "auto",
    start: Annotated[
        str, typer.Option(help="Network to train further, of avatar default or hiker; new: random weights.")
    ] = "default",
    width: Annotated[int, typer.Option(help="Of a new network; 64 is full.")] = 16,
    loss: Annotated[
        str, typer.Option(help="default: the default avatar's; thesis: L1, Dice, perceptual, GAN.")
    ] = "default",
    vgg: Annotated[
        Path | None, typer.Option(help="VGG-16 weights (.pth, .safetensors) for the perceptual loss; else MS-SSIM.")
    ] = None,
    tensorboard: Annotated[bool, typer.Option("--tensorboard", help="Log the losses to WORK/tensorboard too.")] = False,
    json: JsonOption = False,
) -> None:
    """Train an avatar and write it as a folder for `trilane run --avatar`.

    Without a capture, the settings name a look of the default body.

    A command that was ended goes on where it was when it is given again.
    """
    from trilane.training.training_settings import parsed_settings, read_settings

    usual = {"minutes": minutes, "steps": steps, "samples": samples, "seed": seed, "threads": threads, "start": start}
    options = {
        name: value
        for name, value in (usual | {"width": width, "loss": loss, "device": device}).items()
        if name in given(ctx)
    }
    values = read_settings(config).model_dump(by_alias=True, exclude_none=True) if config is not None else {}
    asked = parsed_settings(values | options, "options" if config is None else config)
    if asked.start != "new" and asked.width != DEFAULT_WIDTH:
        raise BadInputError("--width", str(asked.width), f"{DEFAULT_WIDTH} of a trained network", "or --start new")
    _require_torch()
    from trilane.training.train import Places, train_avatar

    if tensorboard and not machine.here.has_package("tensorboard"):
        raise MissingPartError("a log for TensorBoard needs the package tensorboard", extra="tensorboard")
    work = out.parent / f"{out.name}-work" if work is None else work
    places = Places(capture, out, work, out.name, vgg)
    log = EventLog(work / LOG) if tensorboard else None
    with stdout_kept(), _shown(log) as listener:
        facts = train_avatar(places, asked, listener)
    print_facts(facts, json)


def _require_torch() -> None:
    """Raises MissingPartError with the lines that install it."""
    missing = [name for name in ("torch", "scipy", "skimage") if not machine.here.has_package(name)]
    if "torch" in missing:
        lines = f"{package_line('torch')} --index-url {CPU_INDEX} (CPU) or {package_line('torch')} (NVIDIA GPU)"
        raise MissingPartError("training needs torch", f"{lines}, then {install_line('train')}")
    if missing:
        raise MissingPartError(f"training needs {missing[0]}", extra="train")


@contextmanager
def _shown(log: EventLog | None) -> Iterator[_Shown]:
    """Someone who shows a training on stderr: as bars on a terminal, else as lines; and in a `log`, if any."""
    from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn

    console = stderr_console()
    columns = (TextColumn("{task.description}"), BarColumn(), TextColumn("{task.completed}/{task.total}"))
    with Progress(*columns, TimeRemainingColumn(), console=console, disable=not console.is_terminal) as progress:
        try:
            yield _Shown(console, progress, log)
        finally:
            if log is not None:
                log.close()


class _Shown:
    """Shows what a training says; a `train.Listener`."""

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
    """The losses of a training as a log that TensorBoard shows, in `folder`; the first step makes its file.

    A training that goes on takes back what was logged after its state.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._writer: Any = None

    def write(self, step: int, terms: Mapping[str, float], loss: float) -> None:
        """The `terms` of the loss at `step`, before weighting, as `terms/NAME`, and their weighted sum, as `loss`."""
        if self._writer is None:
            self._writer = _writer(self._folder, step)
        self._writer.add_scalar("loss", loss, step)
        for name, value in terms.items():
            self._writer.add_scalar(f"terms/{name}", value, step)

    def close(self) -> None:
        """Write what is left."""
        if self._writer is not None:
            self._writer.close()


def _writer(folder: Path, step: int) -> Any:
    """A writer, for which everything in `folder` from `step` on does not count."""
    from torch.utils.tensorboard import SummaryWriter

    return SummaryWriter(str(folder), purge_step=step, flush_secs=FLUSH_S)
