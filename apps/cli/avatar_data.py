"""Commands of `trilane avatar` about what avatars are trained on: `create-data`, `check-data`.

Rule: this file talks to the person; the work is done in `trilane.training.capture`.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from trilane.apps.cli.console import print_facts, spinner, stderr_console
from trilane.apps.cli.options import JsonOption
from trilane.errors import BadInputError

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from trilane.shapes import Shape
    from trilane.training.capture.capture import Capture
    from trilane.training.capture.synthetic import Recipe, SyntheticCapture

EPILOG_CREATE = """\b
Examples:
  trilane avatar create-data my-capture
  trilane avatar create-data noisy --frames 400 --output 1920x1080 --fit-deg 1 --fit-mm 5 --mask-px 3
"""
EPILOG_CHECK = """\b
Examples:
  trilane avatar check-data my-capture
  trilane avatar check-data my-capture --sheet fits.png --json
"""
MOST_FRAMES = 100_000
LEAST_SIDE, MOST_SIDE = 64, 4096
SHEET = "check-data.png"


def create_data(
    folder: Annotated[Path, typer.Argument(help="Folder to write; it must not be there yet, or be empty.")],
    frames: Annotated[int, typer.Option(min=4, max=MOST_FRAMES, help="Number of frames, from all sides.")] = 120,
    output: Annotated[str, typer.Option(help="Size of a frame in pixels: WIDTHxHEIGHT.")] = "1280x720",
    seed: Annotated[int, typer.Option(min=0, help="Seed of poses, views and noise.")] = 1,
    fit_deg: Annotated[
        float, typer.Option(min=0, max=45, help="Turn joints of the fits by up to so many degrees.")
    ] = 0.0,
    fit_mm: Annotated[float, typer.Option(min=0, max=1000, help="Move the fits by up to so many millimetres.")] = 0.0,
    mask_px: Annotated[
        float, typer.Option(min=0, max=50, help="Move the outline of masks by up to so many pixels.")
    ] = 0.0,
    look: Annotated[
        str, typer.Option(help="Who is drawn: default, or hiker, of another build in other clothes.")
    ] = "default",
    json: JsonOption = False,
) -> None:
    """Draw frames of a synthetic person with masks, fits and the camera: a capture to try the training on.

    With noise the exact masks and fits are kept as a capture of their own, in `truth`.
    """
    from trilane.avatars.bundle import bundle_folder
    from trilane.body.body import load_body
    from trilane.training.capture.capture import BODY
    from trilane.training.capture.synthetic import Recipe, SyntheticCapture, write_capture
    from trilane.training.clothing.looks import look_named
    from trilane.writing import write_folder

    recipe = Recipe(frames, _shape(output), seed, fit_deg, fit_mm, mask_px, look)
    betas = look_named(look).betas
    if folder.exists() and not (folder.is_dir() and not any(folder.iterdir())):
        raise BadInputError(folder, "files" if folder.is_dir() else "a file", "a folder that is not there yet")
    with spinner("putting clothes on the body"):
        capture = SyntheticCapture(load_body(bundle_folder("default") / BODY).shape(betas), recipe)
    _state_cost(capture, recipe)
    with write_folder(folder) as draft, _tracked("drawing frames") as track:
        for _ in track(range(frames), write_capture(draft, capture, recipe)):
            pass
    noise = {"fit_deg": fit_deg, "fit_mm": fit_mm, "mask_px": mask_px}
    facts = {"capture": str(folder), "frames": frames, "size": [*recipe.shape[::-1]], "seed": seed}
    print_facts(
        {**facts, "look": look, "noise": noise, "truth": str(folder / "truth") if recipe.is_noisy else None}, json
    )


def check_data(
    folder: Annotated[Path, typer.Argument(help="Folder of a capture; docs/captures.md says what is in it.")],
    sheet: Annotated[
        Path | None, typer.Option(help=f"Picture to write: the fits over the frames. {SHEET} in the folder if none.")
    ] = None,
    json: JsonOption = False,
) -> None:
    """Say what is wrong with a capture, which frames have bad fits, and which sides and texels no frame shows."""
    from trilane.training.capture.capture import open_capture
    from trilane.writing import require_writable

    picture = folder / SHEET if sheet is None else sheet
    with _tracked("reading pictures") as track:
        capture = open_capture(folder, lambda numbers: track(numbers, numbers))
    require_writable(picture)
    print_facts(_checked(capture, picture), json)


def _checked(capture: Capture, picture: Path) -> dict[str, Any]:
    """What is said of `capture`, whose sheet is written to `picture`."""
    from trilane.training.capture.capture_samples import BodyRaster
    from trilane.training.capture.check import (
        bad_frames,
        capture_facts,
        check_frames,
        chosen,
        coverage_of,
        overlaid,
        require_fits,
        sheet,
    )
    from trilane.writing import write_atomically

    raster, coverage = BodyRaster(capture.shaped), coverage_of(capture)
    with _tracked("drawing fits") as track:
        checks = check_frames(capture, raster, coverage)
        frames = list(track(range(len(capture)), checks))
    bad = bad_frames(frames)
    cells = []
    for frame in sorted(chosen(frames, bad), key=lambda each: each.number):
        uv = raster.uv_of(capture, frame.number)
        text = f"{capture.names[frame.number]}  IoU {frame.iou:.3f}" + ("  BAD" if frame in bad else "")
        cells.append((text, overlaid(capture.picture(frame.number), uv)))
    with write_atomically(picture) as draft:
        sheet(cells).save(draft, format="png")
    require_fits(capture, frames, picture)
    return capture_facts(capture, frames, bad, coverage) | {"sheet": str(picture)}


def _state_cost(capture: SyntheticCapture, recipe: Recipe) -> None:
    """Say on stderr what the frames will take, by one that was drawn."""
    import psutil

    from trilane.training.capture.synthetic import measured_cost

    cost = measured_cost(capture, recipe)
    memory_mb = psutil.Process().memory_info().rss / 1e6
    took = f"about {cost.seconds * recipe.frames:.0f} s, {cost.disk_bytes * recipe.frames / 1e6:.0f} MB on the disk"
    stderr_console().print(f"{took} and {memory_mb:.0f} MB of memory, by one frame that was measured")


def _shape(text: str) -> Shape:
    """(height, width) of `--output`. Raises BadInputError."""
    match = re.fullmatch(r"([0-9]{1,5})x([0-9]{1,5})", text)
    if match is None or not all(LEAST_SIDE <= int(side) <= MOST_SIDE for side in match.groups()):
        expected = f"WIDTHxHEIGHT in pixels, each from {LEAST_SIDE} to {MOST_SIDE}, such as 1280x720"
        raise BadInputError("--output", repr(text), expected)
    return int(match[2]), int(match[1])


@contextmanager
def _tracked(text: str) -> Iterator[Callable[[Sequence[int], Iterable[Any]], Iterable[Any]]]:
    """Wraps something that goes through numbers in a progress bar, when stderr is a terminal."""
    from rich.progress import Progress

    console = stderr_console()
    with Progress(console=console, disable=not console.is_terminal) as progress:
        yield lambda numbers, work: progress.track(work, total=len(numbers), description=text)
