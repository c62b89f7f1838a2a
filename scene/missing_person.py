"""Refuses a recorded camera that does not show the person, and finds out which key of the scene would help.

Nothing in a file tells the axes of a robot's poses, the up of a map or the unit of its lengths for certain. A wrong one
leads to a camera that looks past the person wherever it is placed. So each likely value is tried, and the one that
shows the person most is named; whether it is true only the user knows.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from trilane.body.body import ShapedBody
from trilane.errors import BadInputError
from trilane.scene.camera.files import load_camera
from trilane.scene.camera.path import CameraPath
from trilane.scene.camera.recorded import UP
from trilane.scene.camera_placement import PlacedCamera, place_camera
from trilane.scene.footage import Footage, filmed
from trilane.scene.mover import Mover
from trilane.scene.schema import CameraSpec, Scene
from trilane.scene.staging import Staged
from trilane.scene.visibility import seen_at

#: Least share of the frames in which a recorded camera has to show the person.
ENOUGH = 0.5
#: Number of frames that are looked at; of a longer run as many, evenly spread.
MOST_JUDGED = 120
#: Score of the person's share of the picture's height beside the share of moments: it only breaks ties.
HEIGHT_WEIGHT = 0.01
#: Axes of poses that are tried: of cameras (optical, OpenGL), of robots and of aircraft.
LIKELY_AXES = ("right-down-forward", "right-up-back", "forward-left-up", "forward-right-down")
#: Factors on the unit of lengths that are tried.
FACTORS = (0.3, 0.1, 0.03, 3.0, 10.0)
RUNS_ANYHOW = "--allow-empty runs it as it is"


def require_person(
    scene: Scene,
    staged: Staged,
    bodies: Sequence[ShapedBody],
    base: Path,
    footage: Footage | None = None,
    say: Callable[[str], object] = lambda _: None,
) -> None:
    """Raise BadInputError where the recorded camera of `staged` does not show the person; it names a key that helps.

    A camera that was placed has to show whole bodies, any other a part of one, in half of the frames, of which
    some are looked at. The parameters are those of `stage_scene`, and its result. `say`: function that is given the
    notes and what is tried, before a refusal's trials, which take up to a minute.
    """
    if not staged.camera.path.recorded:
        return
    share, _ = _shares(staged.camera, scene, staged.movers, bodies)
    if _is_enough(share):
        return
    is_placed = scene.camera.place == "auto"
    what = "the whole person" if is_placed else "a part of the person"
    found = f"{what} in the picture in {share:.0%} of the run's frames"
    where = " at the best place" if is_placed else " where it was recorded"
    expected = f"at least {ENOUGH:.0%}"
    for note in staged.notes:
        say(note)
    say(f"camera: {found}{where}; other axes, directions for up and units are tried")
    remedy = _remedy(scene, staged, bodies, base, footage)
    raise BadInputError(f"camera {scene.camera.source}", f"{found}{where}", expected, f"{remedy}; {RUNS_ANYHOW}")


def _is_enough(share: float) -> bool:
    return share >= ENOUGH


def _shares(
    camera: PlacedCamera, scene: Scene, movers: Sequence[Mover], bodies: Sequence[ShapedBody]
) -> tuple[float, float]:
    """Return the share of the frames in which the camera shows the bodies, and their mean share of its height."""
    times = np.linspace(0.0, (scene.frames - 1) / scene.fps, min(MOST_JUDGED, scene.frames))
    seen = seen_at(times, camera, movers, bodies, (scene.output.height, scene.output.width))
    share = seen.whole.mean() if scene.camera.place == "auto" else 1 - seen.nobody.mean()
    return float(share), float(seen.height.mean())


def _remedy(scene: Scene, staged: Staged, bodies: Sequence[ShapedBody], base: Path, footage: Footage | None) -> str:
    """Return what to set, by trial."""
    best, text = 0.0, ""
    for key, value in _variants(scene.camera, staged.camera.path, base):
        spec = scene.camera.model_copy(update={key: value})
        other = scene.model_copy(update={"camera": spec})
        try:
            path, _ = filmed(load_camera(spec, base), footage, (scene.output.height, scene.output.width))
        except BadInputError:
            continue
        share, height = _shares(place_camera(path, other, staged.movers, bodies), other, staged.movers, bodies)
        if _is_enough(share) and share + HEIGHT_WEIGHT * height > best:
            best, text = (
                share + HEIGHT_WEIGHT * height,
                f"camera.{key} = {_toml(value)} would show it in {share:.0%}, if it is true",
            )
    return text or "no single key would show it: check camera.axes, camera.up_axis and camera.metres_per_unit"


def _variants(spec: CameraSpec, path: CameraPath, base: Path) -> Iterator[tuple[str, Any]]:
    """Yield keys of the camera and values that may be true in place of those in use; stated keys stay."""
    if spec.place == "none":
        yield "place", "auto"
        return
    if spec.axes == "auto":
        yield from (("axes", axes) for axes in LIKELY_AXES)
    if spec.up_axis == "auto":
        yield from (("up_axis", axis) for axis in UP)
    unit = _metres_per_unit(spec, path, base)
    yield from (("metres_per_unit", float(f"{unit * factor:.3g}")) for factor in FACTORS)


def _metres_per_unit(spec: CameraSpec, path: CameraPath, base: Path) -> float:
    """Return the metres in a length of 1 of the file that `path` was read with; 1 for a camera that stands still."""
    raw = load_camera(spec.model_copy(update={"metres_per_unit": 1.0}), base)
    length, own = (float(np.linalg.norm(np.ptp(one.places, axis=0))) for one in (path, raw))
    return length / own if own > 0 else 1.0


def _toml(value: str | float) -> str:
    return f'"{value}"' if isinstance(value, str) else f"{value:g}"
