"""Says what a file or folder is, and calls the reader for its kind, which describes it.

Rule: content identifies a file. If the content is ambiguous, the ending of the name decides. To identify a file, this
module reads only its head, the names in an archive, or a whole text. Only the reader of the file's kind reads more.
"""

from __future__ import annotations

import itertools
import json
import tomllib
from collections.abc import Callable, Collection
from dataclasses import replace
from pathlib import Path

from trilane.apps.inspect.inspection import Inspection, refused
from trilane.apps.inspect.readers import (
    inspect_avatar,
    inspect_body,
    inspect_camera,
    inspect_folder,
    inspect_motion,
    inspect_network,
    inspect_picture,
    inspect_profile,
    inspect_report,
    inspect_run,
    inspect_scene,
    inspect_sweep,
    inspect_sweep_file,
    inspect_texture,
    inspect_trace,
    inspect_video,
)
from trilane.apps.run.report import REPORT_FILE
from trilane.avatars.bundle import MANIFEST
from trilane.errors import BadInputError
from trilane.files import (
    ARCHIVE,
    ARRAY,
    FOREIGN,
    PICKLE,
    PICTURE,
    PICTURE_SUFFIXES,
    VIDEO,
    Signature,
    npz_names,
    read_text,
    require_file,
    signature_of,
)
from trilane.pipeline.journal import NAME as JOURNAL
from trilane.scene.camera.files import COLMAP_FILES, detect
from trilane.scene.recordings import Detected

MOTION, CAMERA, PICTURE_FOLDER, BODY, TEXTURE, AVATAR = "motion", "camera", "pictures", "body", "texture", "avatar"
NETWORK, SCENE, TRACE, RUN, REPORT, SWEEP = "network", "scene", "trace", "run", "report", "sweep"
PROFILE, PLANNED_SWEEP, GLTF, OTHER = "hardware profile", "sweep file", "glTF", "other"
EXPECTED = "a motion, camera, picture, video, body, avatar, network, scene, trace or run"
#: Ending of a name -> kind, for files whose content does not show their kind.
ENDINGS = {
    ".bvh": MOTION,
    ".pkl": MOTION,
    ".pickle": MOTION,
    ".onnx": NETWORK,
    ".toml": SCENE,
    ".pftrace": TRACE,
    ".perfetto-trace": TRACE,
    ".mp4": VIDEO,
    ".mov": VIDEO,
    ".mkv": VIDEO,
    ".webm": VIDEO,
    ".avi": VIDEO,
    ".m4v": VIDEO,
    **dict.fromkeys(PICTURE_SUFFIXES, PICTURE),
}
#: Names of files, and the kind of a folder that has one of them. The first match counts.
MARKS: tuple[tuple[tuple[str, ...], str], ...] = (
    ((MANIFEST,), AVATAR),
    ((REPORT_FILE, JOURNAL), RUN),
    (("trials.jsonl",), SWEEP),
)
#: Key of a JSON document -> kind of a file with this key. The first match counts.
JSON_KEYS = {"traceEvents": TRACE, "clock": REPORT, "network": AVATAR, "frames": CAMERA, "poses": CAMERA}
#: Kind -> its reader, and the words for a file of this kind that the reader refuses.
READERS: dict[str, tuple[Callable[[Path], Inspection], str]] = {
    MOTION: (inspect_motion, "a motion, by its content or ending"),
    CAMERA: (inspect_camera, "a camera, by its content"),
    PICTURE: (inspect_picture, "a picture"),
    VIDEO: (inspect_video, "a video"),
    PICTURE_FOLDER: (inspect_folder, "a folder of pictures"),
    BODY: (inspect_body, "a body"),
    TEXTURE: (inspect_texture, "the neural texture of an avatar"),
    AVATAR: (inspect_avatar, "an avatar"),
    NETWORK: (inspect_network, "an ONNX network, by its ending"),
    SCENE: (inspect_scene, "a scene"),
    PROFILE: (inspect_profile, "a hardware profile"),
    RUN: (inspect_run, "a run folder"),
    REPORT: (inspect_report, "the report of a run"),
    SWEEP: (inspect_sweep, "a sweep"),
    PLANNED_SWEEP: (inspect_sweep_file, "a sweep that is to be done"),
    TRACE: (inspect_trace, "a trace"),
}
#: Largest numbers of files of an unknown folder that are identified, and that are named.
MOST_LOOKED_AT, MOST_NAMED = 50, 6
UNKNOWN = Inspection(
    OTHER,
    "nothing that Trilane knows",
    "motions: .bvh, .npz, .npy; cameras: tables of numbers, transforms.json; docs/motion-and-camera.md has all of them",
    problem=f"found neither content nor an ending by which it is known, expected {EXPECTED}",
)
AS_BVH = "export the motion as BVH, such as in Blender: File > Import, then File > Export > Motion Capture (.bvh)"


def inspect_file(path: Path) -> Inspection:
    """Return the inspection of the file or folder `path`. If it is not usable, the inspection says why.

    Raises BadInputError only if `path` is no readable file or folder.
    """
    kind, signature = kind_of(path)
    if signature is not None:
        return _foreign(signature)
    if kind == GLTF:
        return _foreign(Signature("a glTF file", remedy=AS_BVH))
    if kind not in READERS:
        return _folder_of(path) if path.is_dir() else _other(path)
    read, what = READERS[kind]
    try:
        return read(path)
    except BadInputError as error:
        return refused(kind, what, error, path)


def _other(path: Path) -> Inspection:
    """Return UNKNOWN. For a JSON file that does not parse, return an inspection that says so.

    Such a file may be a damaged file of a known kind.
    """
    if path.suffix.lower() != ".json":
        return UNKNOWN
    try:
        json.loads(read_text(path, EXPECTED))
    except (BadInputError, ValueError, RecursionError) as error:
        found = error.found if isinstance(error, BadInputError) else f"no valid JSON ({error})"
        problem = f"found {found}, expected {EXPECTED}"
        return replace(UNKNOWN, what="a broken JSON file", problem=problem, advice="write or download it again")
    return UNKNOWN


def _folder_of(path: Path) -> Inspection:
    """Return the inspection of an unknown folder. The advice names files in this folder whose kind Trilane knows."""
    files = itertools.islice((file for file in sorted(path.iterdir()) if file.is_file()), MOST_LOOKED_AT)
    known = [f"{file.name} ({kind})" for file in files if (kind := _kind_or_none(file)) in READERS]
    if not known:
        return replace(UNKNOWN, what="a folder of nothing that Trilane knows")
    advice = f"name a file of it: {', '.join(known[:MOST_NAMED])}"
    return replace(UNKNOWN, what="a folder that is nothing by itself", advice=advice)


def _kind_or_none(file: Path) -> str | None:
    try:
        kind, signature = kind_of(file)
    except BadInputError:
        return None
    return kind if signature is None else None


def _foreign(signature: Signature) -> Inspection:
    problem = f"found {signature.name}, which Trilane does not read, expected {EXPECTED}"
    found = Detected(signature.name.split(" ", 1)[-1], "the head of the file")
    return Inspection(OTHER, signature.name, signature.remedy, found, problem=problem)


def kind_of(path: Path) -> tuple[str, Signature | None]:
    """Return the kind of `path`, a constant of this module or of `trilane.files`, and its signature or None.

    The signature is given for a file that Trilane does not read: a foreign format, an archive, or a format with a
    remedy. Raises BadInputError if `path` is no readable file or folder.
    """
    try:
        if path.is_dir():
            return _folder(path), None
        require_file(path, EXPECTED)
        signature = signature_of(path)
    except OSError as error:
        raise BadInputError.of_os_error(path, error, EXPECTED) from None
    if signature is None:
        return _by_text(path), None
    if signature.group in (ARRAY, PICKLE):
        return (MOTION if signature.group == PICKLE else _arrays(path)), None
    return signature.group, signature if signature.group in (FOREIGN, ARCHIVE) or signature.remedy else None


def _folder(path: Path) -> str:
    for names, kind in MARKS:
        if any((path / name).exists() for name in names):
            return kind
    if _is_camera(path):
        return CAMERA
    return PICTURE_FOLDER if any(file.suffix.lower() in PICTURE_SUFFIXES for file in path.iterdir()) else OTHER


def _arrays(path: Path) -> str:
    with path.open("rb") as file:
        if file.read(1) != b"P":
            return MOTION  # one array
    names = set(npz_names(path, EXPECTED))
    if "v_template" in names:
        return BODY
    return TEXTURE if "texture" in names else MOTION


def _by_text(path: Path) -> str:
    """Return the kind of a file without a signature in its head: by its name, else its text, else its ending."""
    if path.name == JOURNAL:
        return RUN
    if path.name in COLMAP_FILES:
        return CAMERA
    try:
        text = read_text(path, EXPECTED)
    except BadInputError:
        return ENDINGS.get(path.suffix.lower(), OTHER)
    for looks, kind in _TEXTS:
        if found := looks(text):
            return kind or str(found)
    return ENDINGS.get(path.suffix.lower(), OTHER)


def _is_bvh(text: str) -> bool:
    return text[:200].lstrip().upper().startswith("HIERARCHY")


def _json_kind(text: str) -> str:
    if text[:200].lstrip()[:1] not in ("{", "["):
        return ""
    try:
        document = json.loads(text)
    except (ValueError, RecursionError):
        return ""
    keys = document if isinstance(document, dict) else {}
    if isinstance(keys.get("asset"), dict) and "version" in keys["asset"]:
        return GLTF
    return next((kind for key, kind in JSON_KEYS.items() if key in keys), "")


def _toml_kind(text: str) -> str:
    try:
        keys: Collection[str] = tomllib.loads(text)
    except (ValueError, RecursionError):
        return ""
    if {"units", "title"} <= set(keys):
        return PROFILE
    if "command" in keys:
        return PLANNED_SWEEP
    return SCENE if keys else ""


def _is_camera(path: Path) -> bool:
    try:
        detect(path)
    except BadInputError:
        return False
    return True


def _is_table(text: str) -> bool:
    """Return whether more than half of the first 50 lines are rows of two or more numbers.

    Comments after a `#` are ignored, and so are lines without other text.
    """
    lines = [line.split("#", 1)[0].replace(",", " ").split() for line in text[:20_000].splitlines()[:50]]
    rows = [words for words in lines if words]
    return 2 * sum(_are_numbers(words) for words in rows) > len(rows)


def _are_numbers(words: list[str]) -> bool:
    try:
        return len([float(word) for word in words]) > 1
    except ValueError:
        return False


#: Test of a text, and the kind of a text that passes. If this kind is empty, the test itself returns the kind.
_TEXTS: tuple[tuple[Callable[[str], bool | str], str], ...] = (
    (_is_bvh, MOTION),
    (_json_kind, ""),
    (_is_table, CAMERA),
    (_toml_kind, ""),
)
