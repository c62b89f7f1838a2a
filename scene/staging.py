"""A staged scene: the motions are on the floor, and a camera films them.

`stage_scene` is the only way from a scene and its bodies to what is sampled per frame. Therefore the pose stage does
what the command line reports. Other processes get a staged scene as plain arrays. This round trip is exact: afterwards,
every mover and the camera sample to the same bits; notes are not transferred. Arrays are named `mover.N.FIELD` or
`camera.FIELD`; a field that is None has no array.

`require_person` refuses a recorded camera that does not show the person. No file states for certain the axes of a
robot's poses, the up direction of a map or its unit of length. If one of these facts is wrong, the camera looks past
the person at every place. The refusal tries each likely value and names the one that shows the person most. Only the
user knows whether this value is true.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from trilane.body.body import ShapedBody
from trilane.errors import BadInputError
from trilane.scene.camera.files import load_camera
from trilane.scene.camera.path import CameraPath, Optics
from trilane.scene.camera.recorded import UP
from trilane.scene.camera_placement import PlacedCamera, Way, place_camera
from trilane.scene.footage import Footage, filmed
from trilane.scene.lens import Known, Lens
from trilane.scene.motion.files import load_motion
from trilane.scene.motion.motion import Motion, Wrap
from trilane.scene.mover import Mover, make_mover
from trilane.scene.schema import CameraSpec, Scene
from trilane.scene.visibility import seen_at, seen_notes


@dataclass(frozen=True)
class Staged:
    """The movers and the camera of a scene, in their places.

    `movers`: one per avatar of the scene, in order. `camera`: camera at its place. `notes`: what was decided about
    motions, places, floor and camera, for people.
    """

    movers: tuple[Mover, ...]
    camera: PlacedCamera
    notes: tuple[str, ...]


def stage_scene(scene: Scene, bodies: Sequence[ShapedBody], base: Path, footage: Footage | None = None) -> Staged:
    """Load the motions and the camera of `scene`, and put them in their places.

    `bodies`: body of each avatar.
    `base`: folder at which relative paths start.
    `footage`: facts of the background; None for a drawn background.
    Raises BadInputError when a file is unusable.
    """
    motions = [load_motion(spec, base, body.joints) for spec, body in zip(scene.avatars, bodies, strict=True)]
    movers = tuple(
        make_mover(spec, motion, body) for spec, motion, body in zip(scene.avatars, motions, bodies, strict=True)
    )
    output = scene.output.height, scene.output.width
    path, seen = filmed(load_camera(scene.camera, base), footage, output)
    camera = place_camera(path, scene, movers, bodies)
    notes = [f"motion: {note}" for mover in movers for note in (*mover.motion.notes, *mover.notes)]
    shown = seen_notes(camera, scene, movers, bodies)
    notes += [f"avatars: {note}" for note in _shared_places(scene, movers, bodies)]
    courses = (path.course,) if path.recorded else ()
    notes += [f"camera: {note}" for note in (*path.notes, *courses, *camera.notes, *shown)]
    notes += [f"background: {note}" for note in seen]
    return Staged(movers, camera, tuple(notes))


#: Two avatars whose pelvises are nearer to each other than this along the floor, in metres, are drawn into each other.
APART_M = 0.2


def _shared_places(scene: Scene, movers: Sequence[Mover], bodies: Sequence[ShapedBody]) -> Iterator[str]:
    """Yield a sentence for each avatar that stands, in the first frame, where an earlier avatar stands."""
    pelvises = [body.joints[0] + mover.sample(0.0)[1] for mover, body in zip(movers, bodies, strict=True)]
    places = [(mover.world @ [*pelvis, 1.0])[[0, 2]] for mover, pelvis in zip(movers, pelvises, strict=True)]
    names = [str(avatar.name) for avatar in scene.avatars]
    for number, place in enumerate(places):
        for other in range(number):
            if np.linalg.norm(place - places[other]) < APART_M:
                yield f"{names[other]} and {names[number]} stand in one place; the key `position` moves an avatar"
                break


Arrays = dict[str, NDArray[Any]]

WRAPS, KNOWN = tuple(Wrap), tuple(Known)
MOTION = ("times_s", "poses", "quats", "translation", "travels", "betas", "leg_m")
MOVER = ("world", "scale", "shift", "lift_times_s", "lift_m")
PATH = ("times_s", "quats", "places", "quarter", "is_held", "repeat_s", "began_s", "recorded")
LENS = ("width_px", "height_px", "fx", "fy", "cx", "cy")


def staged_to_arrays(staged: Staged) -> Arrays:
    """Return `staged` as plain arrays by name, without Python objects. Arrays of `staged` are not copied."""
    arrays: Arrays = {"movers": np.array(len(staged.movers))}
    for index, mover in enumerate(staged.movers):
        own = _arrays(mover.motion, MOTION) | _arrays(mover, MOVER) | {"wrap": np.array(WRAPS.index(mover.motion.wrap))}
        arrays |= {f"mover.{index}.{key}": value for key, value in own.items()}
    arrays |= {f"camera.{key}": value for key, value in _camera_arrays(staged.camera).items()}
    return arrays


def staged_from_arrays(arrays: Mapping[str, NDArray[Any]]) -> Staged:
    """Return the scene that `staged_to_arrays` stored, without its notes.

    `arrays`: arrays by name, perhaps read-only; the scene keeps them. Raises KeyError when an array is missing.
    """
    movers = tuple(_mover(with_prefix(arrays, f"mover.{index}.")) for index in range(int(arrays["movers"])))
    return Staged(movers, _camera(with_prefix(arrays, "camera.")), ())


def with_prefix(arrays: Mapping[str, NDArray[Any]], prefix: str) -> Arrays:
    """Return the arrays whose name begins with `prefix`, by the rest of their name."""
    return {key.removeprefix(prefix): value for key, value in arrays.items() if key.startswith(prefix)}


def _arrays(of: object, keys: Sequence[str]) -> Arrays:
    return {key: np.asarray(value) for key in keys if (value := getattr(of, key)) is not None}


def _mover(arrays: Arrays) -> Mover:
    leg_m = arrays.get("leg_m")
    motion = Motion(
        arrays["times_s"],
        arrays["poses"],
        arrays["translation"],
        arrays.get("betas"),
        (),
        WRAPS[int(arrays["wrap"])],
        None if leg_m is None else float(leg_m),
        bool(arrays["travels"]),
    )
    vars(motion)["quats"] = arrays["quats"]  # fills the cached property
    return Mover(
        motion, arrays["world"], float(arrays["scale"]), arrays["shift"], arrays["lift_times_s"], arrays["lift_m"], ()
    )


def _camera_arrays(camera: PlacedCamera) -> Arrays:
    path = camera.path
    return {
        **_arrays(path, PATH),
        "lenses": np.array([[getattr(lens, key) for key in LENS] for lens in path.optics.lenses]),
        "known": np.array([KNOWN.index(lens.known) for lens in path.optics.lenses]),
        "clip_m": np.array([path.optics.near_m, path.optics.far_m]),
        "filmed": np.array(path.optics.filmed, np.int64).reshape(-1, 2),
        "turned": np.array(path.optics.turned, np.int64),
        "pictures": np.array(path.pictures, np.str_),
        "wrap": np.array(WRAPS.index(path.wrap)),
        **_arrays(camera, ("turn", "shift", "mount")),
        "ways": np.array(len(camera.ways)),
        **{f"way.{index}.times_s": way.times_s for index, way in enumerate(camera.ways)},
        **{f"way.{index}.places": way.places for index, way in enumerate(camera.ways)},
        **{f"way.{index}.wrap": np.array(WRAPS.index(way.wrap)) for index, way in enumerate(camera.ways)},
    }


def _camera(arrays: Arrays) -> PlacedCamera:
    path = CameraPath(
        arrays["times_s"],
        arrays["quats"],
        arrays["places"],
        _optics(arrays),
        (),
        WRAPS[int(arrays["wrap"])],
        bool(arrays["recorded"]),
        pictures=tuple(arrays["pictures"].tolist()),
        quarter=int(arrays["quarter"]),
        is_held=bool(arrays["is_held"]),
        repeat_s=float(arrays["repeat_s"]),
        began_s=float(arrays["began_s"]) if "began_s" in arrays else None,
    )
    parts = (with_prefix(arrays, f"way.{index}.") for index in range(int(arrays["ways"])))
    ways = tuple(Way(part["times_s"], part["places"], WRAPS[int(part["wrap"])]) for part in parts)
    return PlacedCamera(path, arrays["turn"], arrays["shift"], arrays["mount"], (), ways)


def _optics(arrays: Arrays) -> Optics:
    near_m, far_m = (float(value) for value in arrays["clip_m"])
    rows = zip(arrays["lenses"], arrays["known"], strict=True)
    lenses = tuple(
        Lens(**dict(zip(LENS, map(float, row), strict=True)), known=KNOWN[int(known)]) for row, known in rows
    )
    filmed = tuple((int(height), int(width)) for height, width in arrays["filmed"])
    return Optics(lenses, near_m, far_m, filmed, tuple(int(quarters) for quarters in arrays["turned"]))


#: A recorded camera has to show the person in at least this share of the frames.
ENOUGH = 0.5
#: Most frames that are examined; in a longer run, frames are evenly spread over the run.
MOST_JUDGED = 120
#: Weight of the person's share of the picture's height, against the share of frames: it only breaks ties.
HEIGHT_WEIGHT = 0.01
#: Axes of poses that are tried: for cameras (optical and OpenGL), for robots and for aircraft.
LIKELY_AXES = ("right-down-forward", "right-up-back", "forward-left-up", "forward-right-down")
#: Factors on the unit of length that are tried.
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
    """Raise BadInputError if the recorded camera of `staged` does not show the person; the remedy names a key.

    Half of the examined frames must show the whole bodies if the camera was placed, or a part of a body otherwise.
    `staged`: result of `stage_scene` for the other parameters. `say`: function that is called with each note and with a
    message. After that, other values are tried for up to a minute.
    """
    if not staged.camera.path.recorded:
        return
    share, _ = _shares(staged.camera, scene, staged.movers, bodies)
    if share >= ENOUGH:
        return
    what, where = ("the whole person", "at the best place")
    if scene.camera.place != "auto":
        what, where = ("a part of the person", "where it was recorded")
    found = f"{what} in the picture in {share:.0%} of the run's frames {where}"
    for note in (*staged.notes, f"camera: {found}; other axes, directions for up and units are tried"):
        say(note)
    remedy = _remedy(scene, staged, bodies, base, footage)
    raise BadInputError(f"camera {scene.camera.source}", found, f"at least {ENOUGH:.0%}", f"{remedy}; {RUNS_ANYHOW}")


def _shares(
    camera: PlacedCamera, scene: Scene, movers: Sequence[Mover], bodies: Sequence[ShapedBody]
) -> tuple[float, float]:
    """Return (share of the frames in which `camera` shows the bodies, mean height of the bodies).

    Only whole bodies count if the camera is placed; otherwise any part of a body counts. The height is a share of the
    picture's height.
    """
    times = np.linspace(0.0, (scene.frames - 1) / scene.fps, min(MOST_JUDGED, scene.frames))
    seen = seen_at(times, camera, movers, bodies, (scene.output.height, scene.output.width))
    share = seen.whole.mean() if scene.camera.place == "auto" else 1 - seen.nobody.mean()
    return float(share), float(seen.height.mean())


def _remedy(scene: Scene, staged: Staged, bodies: Sequence[ShapedBody], base: Path, footage: Footage | None) -> str:
    """Return a remedy in words: the key and value that show the person most, found by trying all variants."""
    best, text = 0.0, "no single key would show it: check camera.axes, camera.up_axis and camera.metres_per_unit"
    for key, value in _variants(scene.camera, staged.camera.path, base):
        spec = scene.camera.model_copy(update={key: value})
        other = scene.model_copy(update={"camera": spec})
        try:
            path, _ = filmed(load_camera(spec, base), footage, (scene.output.height, scene.output.width))
        except BadInputError:
            continue
        share, height = _shares(place_camera(path, other, staged.movers, bodies), other, staged.movers, bodies)
        if share >= ENOUGH and share + HEIGHT_WEIGHT * height > best:
            toml = f'"{value}"' if isinstance(value, str) else f"{value:g}"
            best = share + HEIGHT_WEIGHT * height
            text = f"camera.{key} = {toml} would show it in {share:.0%}, if it is true"
    return text


def _variants(spec: CameraSpec, path: CameraPath, base: Path) -> Iterator[tuple[str, Any]]:
    """Yield each (key of the camera, value) to try. Stated axes and up stay; only placing is tried for `place` none."""
    if spec.place == "none":
        yield "place", "auto"
        return
    if spec.axes == "auto":
        yield from (("axes", axes) for axes in LIKELY_AXES)
    if spec.up_axis == "auto":
        yield from (("up_axis", axis) for axis in UP)
    raw = load_camera(spec.model_copy(update={"metres_per_unit": 1.0}), base)
    length, own = (float(np.linalg.norm(np.ptp(one.places, axis=0))) for one in (path, raw))
    unit = length / own if own > 0 else 1.0
    yield from (("metres_per_unit", float(f"{unit * factor:.3g}")) for factor in FACTORS)
