"""`trilane avatar`: look into avatars and captures, train and validate avatars, quantise their networks.

Rule: this file registers the commands of the group, and only reads options and shows results. It contains `inspect`,
`create`, `levels`, `create-data` and `check-data`. `avatar_train.py` and `avatar_network.py` contain the others.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from trilane.apps.cli import avatar_network, avatar_train
from trilane.apps.cli.commands import AvatarArgument, Commands, JsonOption
from trilane.apps.cli.console import print_facts, spinner, stderr_console
from trilane.errors import BadInputError, MissingPartError

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from trilane.arrays import Shape
    from trilane.training.capture.capture import Capture
    from trilane.training.capture.synthetic import Recipe, SyntheticCapture

app = Commands(
    no_args_is_help=True,
    help="Look into avatars and captures, train and validate avatars, export and quantise their networks.",
)
EPILOG_INSPECT = "\b\nExamples:\n  trilane avatar inspect default\n  trilane avatar inspect my-avatar --json"
EPILOG_CREATE = """\b
Examples:
  trilane avatar create --network mine.onnx --out mine
  trilane avatar create my-avatar --network entropy.onnx --out my-avatar-entropy
  trilane avatar create --network mine.onnx --texture texture.npz --body body.npz --out mine
"""
EPILOG_LEVELS = "\b\nExamples:\n  trilane avatar levels my-avatar"
EPILOG_CREATE_DATA = """\b
Examples:
  trilane avatar create-data my-capture
  trilane avatar create-data noisy --frames 400 --picture 1920x1080 --fit-deg 1 --fit-mm 5 --mask-px 3
"""
EPILOG_CHECK_DATA = """\b
Examples:
  trilane avatar check-data my-capture
  trilane avatar check-data my-capture --sheet fits.png --json
"""
MOST_FRAMES = 100_000
LEAST_SIDE, MOST_SIDE = 64, 4096
SHEET = "check-data.png"


@app.command(epilog=EPILOG_INSPECT)
def inspect(name: AvatarArgument, json: JsonOption = False) -> None:
    """Say what an avatar contains and how good it is, after every check that a run makes."""
    from trilane.apps.avatar_files import bundle_facts
    from trilane.avatars.bundle import load_bundle

    print_facts(bundle_facts(load_bundle(name)), json)


@app.command(epilog=EPILOG_CREATE)
def create(
    out: Annotated[Path, typer.Option("--out", help="Folder of the avatar to write.")],
    name: Annotated[str, typer.Argument(help="Name or folder of the avatar that gives all other parts.")] = "default",
    network: Annotated[
        Path | None, typer.Option(help="Integer network (.onnx), as `trilane avatar quantise` writes it.")
    ] = None,
    texture: Annotated[
        Path | None, typer.Option(help="Neural texture (.npz): `texture` (H, W, C), with `scale` if it is int8.")
    ] = None,
    body: Annotated[Path | None, typer.Option(help="Body (.npz) in the SMPL-X layout, at its mean shape.")] = None,
    json: JsonOption = False,
) -> None:
    """Put another network, texture or body into an avatar, as a new one.

    To train an avatar of a person: docs/own-avatar.md.
    """
    from trilane.apps.avatar_files import Parts, assemble
    from trilane.avatars.bundle import load_bundle

    print_facts(assemble(load_bundle(name), Parts(network, texture, body), out), json)


@app.command(epilog=EPILOG_LEVELS)
def levels(name: AvatarArgument, json: JsonOption = False) -> None:
    """Make coarser levels of an avatar's mesh, and write them into its folder. A distant avatar has fewer triangles.

    The command takes minutes. `trilane avatar inspect` shows the levels.
    """
    from trilane.avatars.bundle import load_bundle

    bundle = load_bundle(name)
    try:
        from trilane.apps.avatar_files import add_levels

        with spinner("making levels of the mesh"):
            facts = add_levels(bundle)
    except ImportError as error:
        raise MissingPartError(f"levels of the mesh need {error.name}", extra="levels") from None
    print_facts(facts, json)


@app.command("create-data", epilog=EPILOG_CREATE_DATA)
def create_data(
    folder: Annotated[Path, typer.Argument(help="Folder to write; a folder that exists must be empty.")],
    frames: Annotated[int, typer.Option(min=4, max=MOST_FRAMES, help="Number of frames, from all sides.")] = 120,
    picture: Annotated[str, typer.Option(help="Size of a frame in pixels: WIDTHxHEIGHT.")] = "1280x720",
    seed: Annotated[int, typer.Option(min=0, help="Seed of poses, views and noise.")] = 1,
    fit_deg: Annotated[
        float, typer.Option(min=0, max=45, help="Noise of the fits: rotate joints by up to this many degrees.")
    ] = 0.0,
    fit_mm: Annotated[
        float, typer.Option(min=0, max=1000, help="Noise of the fits: move bodies by up to this many millimetres.")
    ] = 0.0,
    mask_px: Annotated[
        float, typer.Option(min=0, max=50, help="Noise of the masks: move outlines by up to this many pixels.")
    ] = 0.0,
    look: Annotated[
        str, typer.Option(help="Person to draw: default, hiker or dancer. Each has its own build, clothes and hair.")
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
    from trilane.training.clothing import look_named
    from trilane.writing import write_folder

    recipe = Recipe(frames, _shape(picture), seed, fit_deg, fit_mm, mask_px, look)
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


@app.command("check-data", epilog=EPILOG_CHECK_DATA)
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


app.command(epilog=avatar_train.EPILOG_TRAIN)(avatar_train.train)
app.command(epilog=avatar_train.EPILOG_VALIDATE)(avatar_train.validate)
app.command(epilog=avatar_network.EPILOG_NETWORK)(avatar_network.network)
app.command(epilog=avatar_network.EPILOG_QUANTISE)(avatar_network.quantise)
app.command("quantize", hidden=True)(avatar_network.quantise)  # first name of the command
app.command(epilog=avatar_network.EPILOG_CALIBRATIONS)(avatar_network.calibrations)
app.command(epilog=avatar_network.EPILOG_SPLIT)(avatar_network.split)
app.command(epilog=avatar_network.EPILOG_EXPORT)(avatar_network.export)


def _checked(capture: Capture, picture: Path) -> dict[str, Any]:
    """Check `capture`, write a sheet of fits to the file `picture`, and return the facts that the command prints.

    The sheet shows the fits of some frames, each over the picture of its frame.
    Raises BadInputError if the fits do not match the masks.
    """
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
    """Measure one frame. Print the estimated time and disk space of all frames, and the memory in use, on stderr."""
    import psutil

    from trilane.training.capture.synthetic import measured_cost

    cost = measured_cost(capture, recipe)
    memory_mb = psutil.Process().memory_info().rss / 1e6
    took = f"about {cost.seconds * recipe.frames:.0f} s, {cost.disk_bytes * recipe.frames / 1e6:.0f} MB on the disk"
    stderr_console().print(f"{took} and {memory_mb:.0f} MB of memory, by one frame that was measured")


def _shape(text: str) -> Shape:
    """Return (height, width) in pixels from `text`, the value WIDTHxHEIGHT of `--picture`.

    Raises BadInputError for another form, and for a side that is too short or too long.
    """
    match = re.fullmatch(r"([0-9]{1,5})x([0-9]{1,5})", text)
    if match is None or not all(LEAST_SIDE <= int(side) <= MOST_SIDE for side in match.groups()):
        expected = f"WIDTHxHEIGHT in pixels, each from {LEAST_SIDE} to {MOST_SIDE}, such as 1280x720"
        raise BadInputError("--picture", repr(text), expected)
    return int(match[2]), int(match[1])


@contextmanager
def _tracked(text: str) -> Iterator[Callable[[Sequence[int], Iterable[Any]], Iterable[Any]]]:
    """Yield a function `track(numbers, work)` that yields the items of `work` and shows a progress bar.

    The bar is shown only if stderr is a terminal. `numbers`: any sequence that is as long as `work`. `text`: label of
    the bar.
    """
    from rich.progress import Progress

    console = stderr_console()
    with Progress(console=console, disable=not console.is_terminal) as progress:
        yield lambda numbers, work: progress.track(work, total=len(numbers), description=text)
