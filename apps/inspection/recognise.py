"""Which kind of thing a file or folder is, by its content and, where that leaves it open, by the ending of its name.

Rule: nothing is loaded to tell; at most the head of a file, the names in an archive or a JSON document are looked at.
"""

from __future__ import annotations

import json
import tomllib
from collections.abc import Callable, Collection
from pathlib import Path

from trilane.avatars.bundle import MANIFEST
from trilane.errors import BadInputError
from trilane.files import (
    ARCHIVE,
    ARRAY,
    FOREIGN,
    PICKLE,
    PICTURE,
    VIDEO,
    Signature,
    npz_names,
    read_text,
    require_file,
    signature_of,
)
from trilane.pipeline.journal import NAME as JOURNAL
from trilane.scene.camera.files import COLMAP_FILES, detect
from trilane.stages.gpu.background import PICTURES

MOTION, CAMERA, PICTURE_FOLDER, BODY, TEXTURE, AVATAR = "motion", "camera", "pictures", "body", "texture", "avatar"
NETWORK, SCENE, TRACE, RUN, REPORT, SWEEP = "network", "scene", "trace", "run", "report", "sweep"
PROFILE, PLANNED_SWEEP, GLTF, OTHER = "hardware profile", "sweep file", "glTF", "other"
EXPECTED = "a motion, camera, picture, video, body, avatar, network, scene, trace or run"
#: Endings that say what their files are, where the head of the file does not.
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
    **dict.fromkeys(PICTURES, PICTURE),
}
#: Files by which a folder is known, and what it is. The first that is there counts.
MARKS: tuple[tuple[tuple[str, ...], str], ...] = (
    ((MANIFEST,), AVATAR),
    (("report.json", JOURNAL), RUN),
    (("trials.jsonl",), SWEEP),
)
#: Key of a JSON document -> what a file with it is. The first that is there counts.
JSON_KEYS = {"traceEvents": TRACE, "clock": REPORT, "network": AVATAR, "frames": CAMERA, "poses": CAMERA}


def kind_of(path: Path) -> tuple[str, Signature | None]:
    """One of the words above or of `trilane.files`; with FOREIGN, and an archive, its signature.

    Raises BadInputError for what is no readable file or folder.
    """
    if path.is_dir():
        return _folder(path), None
    require_file(path, EXPECTED)
    try:
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
    return PICTURE_FOLDER if any(file.suffix.lower() in PICTURES for file in path.iterdir()) else OTHER


def _arrays(path: Path) -> str:
    with path.open("rb") as file:
        if file.read(1) != b"P":
            return MOTION  # one array
    names = set(npz_names(path, EXPECTED))
    if "v_template" in names:
        return BODY
    return TEXTURE if "texture" in names else MOTION


def _by_text(path: Path) -> str:
    """The kind of a file without a signature: text, or a format that has none."""
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
    """Whether most of the first lines that are no comments are numbers."""
    lines = [line.split("#", 1)[0].replace(",", " ").split() for line in text[:20_000].splitlines()[:50]]
    rows = [words for words in lines if words]
    return 2 * sum(_are_numbers(words) for words in rows) > len(rows)


def _are_numbers(words: list[str]) -> bool:
    try:
        return len([float(word) for word in words]) > 1
    except ValueError:
        return False


_TEXTS: tuple[tuple[Callable[[str], bool | str], str], ...] = (
    (_is_bvh, MOTION),
    (_json_kind, ""),
    (_is_table, CAMERA),
    (_toml_kind, ""),
)
