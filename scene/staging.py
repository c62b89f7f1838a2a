"""A scene with everything in its place: the motions on the floor, and a camera that films them.

`stage_scene` is the only way from a scene and its bodies to what is sampled per frame, so the pose stage does what the
command line reports. Other processes get a staged scene as plain arrays. That round trip is exact: every mover and the
camera sample to the same bits afterwards; notes do not travel. A key is `mover.N.FIELD` or `camera.FIELD`; a field that
is None has no key.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from trilane.body.body import ShapedBody
from trilane.scene.camera.files import load_camera
from trilane.scene.camera.path import CameraPath, Optics
from trilane.scene.camera_placement import PlacedCamera, Way, place_camera
from trilane.scene.footage import Footage, filmed
from trilane.scene.lens import Known, Lens
from trilane.scene.motion.files import load_motion
from trilane.scene.motion.motion import Motion, Wrap
from trilane.scene.mover import Mover, make_mover
from trilane.scene.schema import Scene
from trilane.scene.visibility import seen_notes


@dataclass(frozen=True)
class Staged:
    """A staged scene.

    `movers`: one per avatar of the scene. `notes`: what was decided about motions, floor and camera, for people.
    """

    movers: tuple[Mover, ...]
    camera: PlacedCamera
    notes: tuple[str, ...]


def stage_scene(scene: Scene, bodies: Sequence[ShapedBody], base: Path, footage: Footage | None = None) -> Staged:
    """Load the motions and the camera of `scene`, whose avatars have `bodies`; relative paths start at `base`.

    `footage`: facts of its background; None for a drawn one. Raises BadInputError when a file is unusable.
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
    courses = (path.course,) if path.recorded else ()
    notes += [f"camera: {note}" for note in (*path.notes, *courses, *camera.notes, *shown)]
    notes += [f"background: {note}" for note in seen]
    return Staged(movers, camera, tuple(notes))


Arrays = dict[str, NDArray[Any]]

WRAPS, KNOWN = tuple(Wrap), tuple(Known)
LENS = ("width_px", "height_px", "fx", "fy", "cx", "cy")


def staged_to_arrays(staged: Staged) -> Arrays:
    """Return the arrays of `staged`, copied only where it has none yet. They hold no Python objects."""
    arrays: Arrays = {"movers": np.array(len(staged.movers))}
    for index, mover in enumerate(staged.movers):
        arrays |= {f"mover.{index}.{key}": value for key, value in _mover_arrays(mover).items()}
    arrays |= {f"camera.{key}": value for key, value in _camera_arrays(staged.camera).items()}
    return arrays


def staged_from_arrays(arrays: Mapping[str, NDArray[Any]]) -> Staged:
    """Return the scene that `staged_to_arrays` stored, without its notes; it keeps `arrays`, which may be read-only.

    Raises KeyError when one is missing.
    """
    movers = tuple(_mover(_below(arrays, f"mover.{index}.")) for index in range(int(arrays["movers"])))
    return Staged(movers, _camera(_below(arrays, "camera.")), ())


def _below(arrays: Mapping[str, NDArray[Any]], prefix: str) -> Arrays:
    return {key.removeprefix(prefix): value for key, value in arrays.items() if key.startswith(prefix)}


def _mover_arrays(mover: Mover) -> Arrays:
    motion = mover.motion
    optional = {"betas": motion.betas, "leg_m": motion.leg_m}
    return {
        "times_s": motion.times_s,
        "poses": motion.poses,
        "quats": motion.quats,
        "translation": motion.translation,
        "wrap": np.array(WRAPS.index(motion.wrap)),
        "travels": np.array(motion.travels),
        "world": mover.world,
        "scale": np.array(mover.scale),
        "shift": mover.shift,
        "lift_times_s": mover.lift_times_s,
        "lift_m": mover.lift_m,
        **{key: np.asarray(value) for key, value in optional.items() if value is not None},
    }


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
    vars(motion)["quats"] = arrays["quats"]  # sets the cached property, which otherwise is computed at the first sample
    return Mover(
        motion, arrays["world"], float(arrays["scale"]), arrays["shift"], arrays["lift_times_s"], arrays["lift_m"], ()
    )


def _camera_arrays(camera: PlacedCamera) -> Arrays:
    path = camera.path
    return {
        "times_s": path.times_s,
        "quats": path.quats,
        "places": path.places,
        "lenses": np.array([[getattr(lens, key) for key in LENS] for lens in path.optics.lenses]),
        "known": np.array([KNOWN.index(lens.known) for lens in path.optics.lenses]),
        "clip_m": np.array([path.optics.near_m, path.optics.far_m]),
        "filmed": np.array(path.optics.filmed, np.int64).reshape(-1, 2),
        "turned": np.array(path.optics.turned, np.int64),
        "pictures": np.array(path.pictures, np.str_),
        "quarter": np.array(path.quarter),
        "is_held": np.array(path.is_held),
        "repeat_s": np.array(path.repeat_s),
        **({} if path.began_s is None else {"began_s": np.array(path.began_s)}),
        "wrap": np.array(WRAPS.index(path.wrap)),
        "recorded": np.array(path.recorded),
        "turn": camera.turn,
        "shift": camera.shift,
        "mount": camera.mount,
        "ways": np.array(len(camera.ways)),
        **{f"way.{index}.{key}": value for index, way in enumerate(camera.ways) for key, value in _way(way).items()},
    }


def _way(way: Way) -> Arrays:
    return {"times_s": way.times_s, "places": way.places, "wrap": np.array(WRAPS.index(way.wrap))}


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
    parts = (_below(arrays, f"way.{index}.") for index in range(int(arrays["ways"])))
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
