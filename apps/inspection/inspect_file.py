"""Says what a file or folder is. Rule: it is recognised by content, and then read by the reader of its kind alone."""

from __future__ import annotations

import itertools
import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

from trilane.apps.inspection import parts, recognise
from trilane.apps.inspection.inspection import Inspection, refused
from trilane.apps.inspection.moving import inspect_camera, inspect_motion
from trilane.apps.inspection.pictures import inspect_folder, inspect_picture, inspect_video
from trilane.errors import BadInputError
from trilane.files import PICTURE, VIDEO, Signature, read_text
from trilane.scene.recordings import Detected

#: Kind -> how it is read, and what one of it is called before it was read.
READERS: dict[str, tuple[Callable[[Path], Inspection], str]] = {
    recognise.MOTION: (inspect_motion, "a motion, by its content or ending"),
    recognise.CAMERA: (inspect_camera, "a camera, by its content"),
    PICTURE: (inspect_picture, "a picture"),
    VIDEO: (inspect_video, "a video"),
    recognise.PICTURE_FOLDER: (inspect_folder, "a folder of pictures"),
    recognise.BODY: (parts.inspect_body, "a body"),
    recognise.TEXTURE: (parts.inspect_texture, "the neural texture of an avatar"),
    recognise.AVATAR: (parts.inspect_avatar, "an avatar"),
    recognise.NETWORK: (parts.inspect_network, "an ONNX network, by its ending"),
    recognise.SCENE: (parts.inspect_scene, "a scene"),
    recognise.PROFILE: (parts.inspect_profile, "a hardware profile"),
    recognise.RUN: (parts.inspect_run, "a run folder"),
    recognise.REPORT: (parts.inspect_report, "the report of a run"),
    recognise.SWEEP: (parts.inspect_sweep, "a sweep"),
    recognise.PLANNED_SWEEP: (parts.inspect_sweep_file, "a sweep that is to be done"),
    recognise.TRACE: (parts.inspect_trace, "a trace"),
}
#: Of a folder: files that are looked at, and those that are named.
MOST_LOOKED_AT, MOST_NAMED = 50, 6
UNKNOWN = Inspection(
    recognise.OTHER,
    "nothing that Trilane knows",
    f"found neither content nor an ending by which it is known, expected {recognise.EXPECTED}",
    "motions: .bvh, .npz, .npy; cameras: tables of numbers, transforms.json; docs/motion-and-camera.md has all of them",
)
AS_BVH = "export the motion as BVH, such as in Blender: File > Import, then File > Export > Motion Capture (.bvh)"


def inspect_file(path: Path) -> Inspection:
    """What `path` is, usable or not. Raises BadInputError only where there is no readable file or folder."""
    kind, signature = recognise.kind_of(path)
    if signature is not None:
        return _foreign(signature)
    if kind == recognise.GLTF:
        return _foreign(Signature("a glTF file", remedy=AS_BVH))
    if kind not in READERS:
        return _folder_of(path) if path.is_dir() else _other(path)
    read, what = READERS[kind]
    try:
        return read(path)
    except BadInputError as error:
        return refused(kind, what, error, path)


def _other(path: Path) -> Inspection:
    """Of a file that is nothing that Trilane knows; JSON that is broken may have been something."""
    if path.suffix.lower() != ".json":
        return UNKNOWN
    try:
        json.loads(read_text(path, recognise.EXPECTED))
    except (BadInputError, ValueError, RecursionError) as error:
        found = error.found if isinstance(error, BadInputError) else f"no valid JSON ({error})"
        problem = f"found {found}, expected {recognise.EXPECTED}"
        return replace(UNKNOWN, what="a broken JSON file", problem=problem, advice="write or download it again")
    return UNKNOWN


def _folder_of(path: Path) -> Inspection:
    """Of a folder that is nothing by itself: the files in it that may be meant."""
    files = itertools.islice((file for file in sorted(path.iterdir()) if file.is_file()), MOST_LOOKED_AT)
    known = [f"{file.name} ({kind})" for file in files if (kind := _kind_or_none(file)) in READERS]
    if not known:
        return replace(UNKNOWN, what="a folder of nothing that Trilane knows")
    advice = f"name a file of it: {', '.join(known[:MOST_NAMED])}"
    return replace(UNKNOWN, what="a folder that is nothing by itself", advice=advice)


def _kind_or_none(file: Path) -> str | None:
    try:
        kind, signature = recognise.kind_of(file)
    except BadInputError:
        return None
    return kind if signature is None else None


def _foreign(signature: Signature) -> Inspection:
    problem = f"found {signature.name}, which Trilane does not read, expected {recognise.EXPECTED}"
    found = Detected(signature.name.split(" ", 1)[-1], "the head of the file")
    return Inspection(recognise.OTHER, signature.name, problem, signature.remedy, found)
