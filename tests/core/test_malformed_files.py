"""More than a hundred malformed files: each is refused in one sentence with the right reason; nothing is left behind.

Rule: a row has what stands in the file and the words that its reason must have, worked out from what is wrong with it.
Each is given to the reader that a run uses, and to `trilane inspect`.
"""

from __future__ import annotations

import io
import json
import os
import pickle
import shutil
import struct
import threading
import wave
import zipfile
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from support.fuzz_readers import READERS, open_files
from support.small_inputs import (
    arkit_text,
    body_arrays,
    bvh_text,
    nerf_text,
    poses,
    tum_text,
    write_small_inputs,
)
from trilane.apps.inspect.inspect_file import inspect_file
from trilane.errors import BadInputError

Content = bytes | str | Callable[[Path], Any]
MOTION, CAMERA, BACKGROUND, BODY, SCENE, NETWORK, AVATAR = (
    READERS[name] for name in ("walk.bvh", "tum.txt", "photo.png", "body.npz", "scene.toml", "network.onnx", "avatar")
)
FBX = b"Kaydara FBX Binary  \0\x1a\0\xe8\x1c\0\0" + bytes(100)
BVH, ARKIT, TUM, NERF = bvh_text(), arkit_text(), tum_text(), nerf_text()
ROWS = BVH.splitlines()
FIRST = next(k for k, line in enumerate(ROWS) if line.startswith("Frame Time")) + 1


def arrays(**changed: Any) -> Callable[[Path], None]:
    """An AMASS file with other arrays; None leaves one out."""
    sound = {"poses": poses(joints=52), "trans": np.zeros((4, 3)), "mocap_framerate": np.array(60.0)}
    kept = {key: value for key, value in (sound | changed).items() if value is not None}
    return lambda path: np.savez(path, **kept)


def body(**changed: Any) -> Callable[[Path], None]:
    kept = {key: value for key, value in (body_arrays() | changed).items() if value is not None}
    return lambda path: np.savez(path, **kept)


def array(value: Any, cut: int | None = None) -> bytes:
    file = io.BytesIO()
    np.save(file, value)
    return file.getvalue()[:cut]


def npy_header(shape: str, descr: str = "'<f8'") -> bytes:
    text = f"{{'descr': {descr}, 'fortran_order': False, 'shape': {shape}, }}\n".encode()
    return b"\x93NUMPY\x01\0" + struct.pack("<H", len(text)) + text


def archive(**members: bytes) -> Callable[[Path], None]:
    def write(path: Path) -> None:
        with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as file:
            for name, content in members.items():
                file.writestr(f"{name}.npy", content)

    return write


def encrypted(path: Path) -> None:
    """The flag of an encrypted member, in both headers."""
    arrays()(path)
    content = bytearray(path.read_bytes())
    for mark, at in ((b"PK\x03\x04", 6), (b"PK\x01\x02", 8)):
        place = content.find(mark)
        while place >= 0:
            content[place + at] |= 1
            place = content.find(mark, place + 1)
    path.write_bytes(content)


def cut_file(name: str, share: float) -> Callable[[Path], None]:
    """The small input `name`, without its end."""

    def write(path: Path) -> None:
        folder = path.with_name("whole")
        folder.mkdir()
        content = write_small_inputs(folder, name)[name].read_bytes()
        shutil.rmtree(folder)
        path.write_bytes(content[: int(len(content) * share)])

    return write


def picture_of(width: int, height: int) -> bytes:
    """A PNG that says that it has so many pixels, and holds none."""

    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    head = struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", head) + chunk(b"IDAT", zlib.compress(bytes(100))) + chunk(b"IEND", b"")


def sound_only(path: Path) -> None:
    with path.open("wb") as file, wave.open(file) as sound:
        sound.setnchannels(1)
        sound.setsampwidth(2)
        sound.setframerate(8000)
        sound.writeframes(bytes(1600))


def bvh(change: Callable[[list[str]], None]) -> str:
    lines = list(ROWS)
    change(lines)
    return "\n".join(lines) + "\n"


def line_is(index: int, text: str) -> str:
    return bvh(lambda lines: lines.__setitem__(index, text))


def nerf(**changed: Any) -> str:
    return json.dumps(json.loads(NERF) | changed)


def nerf_matrix(matrix: Any, frames: slice = slice(0, 1)) -> str:
    document = json.loads(NERF)
    for frame in document["frames"][frames]:
        frame["transform_matrix"] = matrix
    return json.dumps(document)


def columns(text: str, change: Callable[[list[str]], list[str]], first: int = 0) -> str:
    """A table whose rows from `first` on are changed; its comments stay before them."""
    comments = [line for line in text.splitlines() if line.startswith("#")]
    rows = [line for line in text.splitlines() if not line.startswith("#")]
    changed = [" ".join(change(row.split())) if k >= first else row for k, row in enumerate(rows)]
    return "\n".join([*comments, *changed]) + "\n"


def avatar(change: Callable[[Path], Any]) -> Callable[[Path], None]:
    def write(path: Path) -> None:
        folder = path.with_name("whole")
        folder.mkdir()
        shutil.copytree(write_small_inputs(folder, "avatar")["avatar"], path)
        shutil.rmtree(folder)
        change(path)

    return write


def manifest(**changed: Any) -> Callable[[Path], None]:
    def write(folder: Path) -> None:
        path = folder / "manifest.json"
        path.write_text(json.dumps(json.loads(path.read_text()) | changed))

    return avatar(write)


def folder_of(**files: bytes) -> Callable[[Path], None]:
    def write(path: Path) -> None:
        path.mkdir()
        for name, content in files.items():
            (path / f"{name}.png").write_bytes(content)

    return write


def loop(path: Path) -> None:
    path.symlink_to(path)


def dangling(path: Path) -> None:
    path.symlink_to(path.with_name("gone"))


#: Of every reader of single files: what it is, and the words of its reason.
ANY_FILE: dict[str, tuple[Content, str]] = {
    "empty": (b"", "an empty file"),
    "missing": (lambda _: None, "no such file"),
    "pipe": (os.mkfifo, "a device, a pipe or a socket"),
    "loop of links": (loop, "a link that leads back to itself"),
    "link to nothing": (dangling, "gone, which is not there"),
}
NAMES = {MOTION: "a.bvh", CAMERA: "a.txt", BACKGROUND: "a.png", BODY: "a.npz", SCENE: "a.toml", NETWORK: "a.onnx"}
#: Of every reader of texts: the same.
ANY_TEXT: dict[str, tuple[Content, str]] = {
    "FBX": (FBX, "an FBX file"),
    "UTF-16": ("HIERARCHY 1 2 3\n".encode("utf-16"), "text in UTF-16"),
    "no UTF-8": (b"Huefte: H\xfcfte 1 2 3\n", "cannot be read as text"),
    "NUL": (b"1 2 3\n4 \0 5\n", "line 2: found a NUL byte"),
    "web page": (b"<!DOCTYPE html>\n<html><title>404</title>", "a web page"),
    "packed": (b"\x1f\x8b\x08\0" + bytes(20), "a packed file"),
}
OF_NO_READER: dict[str, tuple[Content, str]] = {
    "FBX": (FBX, "an FBX file"),
    "text": (BVH, "the ending '.fbx'"),
    "missing": (lambda _: None, "no such file"),
}
BVH_FILES: dict[str, tuple[Content, str]] = {
    "no hierarchy": ("\n".join(ROWS[1:]), "line 1: found 'ROOT'"),
    "no motion": (BVH.partition("MOTION")[0], "expected a line MOTION"),
    "cut hierarchy": (BVH[:150], "the end of the file"),
    "cut in the frames": ("\n".join(ROWS[:-2]), f"line {len(ROWS) - 2}: found 2 frames"),
    "cut in a row": (BVH[: -len(ROWS[-1]) // 2], f"line {len(ROWS)}"),
    "minus one frame": (line_is(FIRST - 2, "Frames: -1"), "-1 frames"),
    "a billion frames": (line_is(FIRST - 2, "Frames: 1000000000"), "1e+09 frames"),
    "frames in words": (line_is(FIRST - 2, "Frames: four"), f"line {FIRST - 1}"),
    "no frame time": (line_is(FIRST - 1, "Frame Time: 0"), "0 s a frame"),
    "frame time nan": (line_is(FIRST - 1, "Frame Time: nan"), f"line {FIRST}"),
    "a column less": (line_is(FIRST + 1, ROWS[FIRST + 1].rpartition(" ")[0]), f"line {FIRST + 2}"),
    "a column more": (line_is(FIRST + 1, ROWS[FIRST + 1] + " 0"), f"line {FIRST + 2}"),
    "a word in a row": (line_is(FIRST + 1, ROWS[FIRST + 1] + "x"), f"line {FIRST + 2}"),
    "unknown channel": (BVH.replace("Zrotation", "Wrotation", 1), "'Wrotation'"),
    "nine channels": (BVH.replace("CHANNELS 6", "CHANNELS 9", 1), "9 channels"),
    "offset nan": (BVH.replace("OFFSET 0 95 0", "OFFSET 0 nan 0", 1), "'nan'"),
    "too many joints": ("HIERARCHY\nROOT a {\nOFFSET 0 0 0\n" + "JOINT b {\nOFFSET 0 0 0\n" * 2000, "more than 1000"),
    "a chair": (BVH.replace("Leg", "Chair").replace("Hips", "Seat"), "joints"),
    "legs of no length": (BVH.replace("0 -42 0", "0 0 0"), "legs of no length"),
    "all frames nan": (
        bvh(lambda lines: lines.__setitem__(slice(FIRST, None), ["nan " * 51] * 4)),
        "in all of 4 frames",
    ),
}
ARRAY_FILES: dict[str, tuple[Content, str]] = {
    "text": (BVH, "no readable NumPy array"),
    "picture": (picture_of(4, 4), "a PNG picture"),
    "FBX": (FBX, "an FBX file"),
    "cut header": (array(poses(), cut=40), "no readable NumPy array"),
    "cut data": (array(poses(), cut=-9), "truncated"),
    "objects": (npy_header("(3,)", "'|O'") + b"x" * 24, "no readable pickle"),
    "164 columns": (array(np.zeros((4, 164))), "shape (4, 164)"),
    "no rows": (array(np.zeros((0, 165))), "shape (0, 165)"),
    "one axis": (array(np.zeros(165)), "shape (165,)"),
    "words": (array(np.full((4, 165), "a")), "dtype <U1"),
    "complex": (array(np.zeros((4, 165), complex)), "dtype complex128"),
    "bomb": (npy_header("(99999999, 165)") + bytes(8), "at most 1073741824 bytes"),
    "degrees": (array(np.full((4, 165), 90.0)), "an angle of 90"),
    "nan": (array(np.full((4, 165), np.nan)), "4 samples that are not finite (first: number 0)"),
    "places nan": (array(np.full((4, 22, 3), np.nan)), "that are not finite"),
    "a joint nan": (array(np.where(np.arange(22)[:, None] == 21, np.nan, np.ones((4, 22, 3)))), "that are not finite"),
    "version 9": (b"\x93NUMPY\x09\0" + bytes(100), ".npy version (9, 0)"),
}
PICKLES: dict[str, tuple[Content, str]] = {
    "text": ("a letter", "no readable pickle"),
    "FBX": (FBX, "an FBX file"),
    "escapes": (b"S'\\u0031 \\x'\n.", "no readable pickle"),
    "cut": (pickle.dumps({"smpl_poses": np.zeros((4, 72))})[:-20], "no readable pickle"),
    "a call": (pickle.dumps(print), "print"),
}
AMASS_FILES: dict[str, tuple[Content, str]] = {
    "text": ("poses", "no readable .npz archive"),
    "FBX": (FBX, "an FBX file"),
    "cut": (cut_file("amass.npz", 0.6), "no readable .npz archive"),
    "encrypted": (encrypted, "encrypted"),
    "100 columns": (arrays(poses=np.zeros((4, 100))), "shape (4, 100)"),
    "no frames": (arrays(poses=np.zeros((0, 156)), trans=np.zeros((0, 3))), "shape (0, 156)"),
    "one place more": (arrays(trans=np.zeros((5, 3))), "shape (5, 3)"),
    "swapped places": (arrays(trans=np.zeros((3, 4))), "shape (3, 4)"),
    "no rate": (arrays(mocap_framerate=None), "no frame rate"),
    "rate 0": (arrays(mocap_framerate=np.array(0.0)), "[mocap_framerate]: found"),
    "rate nan": (arrays(mocap_framerate=np.array(np.nan)), "[mocap_framerate]: found"),
    "betas nan": (arrays(betas=np.full(10, np.nan)), "[betas]: found"),
    "poses in words": (arrays(poses=np.full((4, 156), "a")), "dtype <U1"),
    "bomb": (archive(poses=npy_header("(999999999, 156)") + bytes(1 << 20)), "at most 1073741824 bytes"),
    "shorter than it says": (archive(poses=npy_header("(40, 156)") + bytes(80)), "truncated"),
    "degrees": (arrays(poses=np.full((4, 156), 90.0)), "an angle of 90"),
    "nan": (arrays(poses=np.full((4, 156), np.nan)), "4 samples that are not finite (first: number 0)"),
    "places nan": (arrays(trans=np.full((4, 3), np.inf)), "4 samples that are not finite (first: number 0)"),
    "places of another planet": (
        arrays(trans=np.full((4, 3), 2e4)),
        "that are 10 km or more from the origin",
    ),
}
TABLES: dict[str, tuple[Content, str]] = {
    "words": ("a letter\nof words\n", "columns"),
    "brackets without end": ("1 2 " + "[" * 200_000 + "\n", "found 3 columns"),
    "comments alone": ("# time\n# and place\n", "columns"),
    "a row of seven": (columns(TUM, lambda row: row[:7], first=3), "line 5: found 7 columns"),
    "a word": (columns(TUM, lambda row: [*row[:7], "x"], first=3), "line 5: found"),
    "no rotation": (columns(TUM, lambda row: [*row[:4], "0", "0", "0", "0"]), "5 samples that are "),
    "mirrored": (columns(ARKIT, lambda row: [*row[:1], row[3], row[2], row[1], *row[4:]]), "of 5"),
    "nan": (columns(ARKIT, lambda row: ["nan" for _ in row]), "of 5"),
    "one time": (columns(TUM, lambda row: ["7", *row[1:]]), "4 times that do not increase"),
    "a picture": (picture_of(4, 4), "a PNG picture"),
}
NERF_FILES: dict[str, tuple[Content, str]] = {
    "cut": (NERF[:300], "no valid JSON"),
    "a list": ("[1, 2]", "no list `frames`"),
    "frames in words": (nerf(frames="many"), "no list `frames`"),
    "no frames": (nerf(frames=[]), "0 frames"),
    "no matrix": (nerf(frames=[{}]), "frames[0]"),
    "3x3": (nerf_matrix(np.eye(3).tolist()), "shape (3, 3)"),
    "words": (nerf_matrix([["a"] * 4] * 4), "frames[0].transform_matrix"),
    "no inverse": (nerf_matrix(np.zeros((4, 4)).tolist()), "without an inverse"),
    "no rotation": (nerf_matrix((3 * np.eye(4)).tolist(), slice(None)), "of 5"),
    "nan": (nerf_matrix(np.full((4, 4), np.nan).tolist(), slice(None)), "of 5"),
    "an angle of a circle": (nerf(camera_angle_x=6.3), "camera_angle_x"),
    "no pixel": (nerf(w=1e-320, h=1e-320), "sides of 1 to 1e+06 pixels"),
    "negative width": (nerf(w=-640), "w: found -640"),
    "nested": ('{"frames": ' + "[" * 100_000, "no valid JSON"),
}


def colmap(name: str, file: str, change: Callable[[bytes], bytes]) -> Callable[[Path], None]:
    """The model of `small_inputs` with one of its files changed."""

    def write(path: Path) -> None:
        write_small_inputs(path.parent, name)[name].rename(path)
        place = next(path.rglob(file))
        place.write_bytes(change(place.read_bytes()))

    return write


MODELS: dict[str, tuple[Content, str]] = {
    "another camera": (
        colmap("colmap", "images.txt", lambda text: text.replace(b" 7 view", b" 8 " + b"v" * 200)),
        "camera 8, expected a camera of the model",
    ),
    "cut images": (colmap("colmap-binary", "images.bin", lambda data: data[:-20]), "images.bin"),
    "more images than bytes": (
        colmap("colmap-binary", "images.bin", lambda data: b"\xff" * 4 + data[4:]),
        "images.bin",
    ),
    "no lens": (colmap("colmap", "cameras.txt", lambda text: text.replace(b"510.0", b"nan")), "cameras.txt"),
    "FBX": (colmap("colmap", "images.txt", lambda _: FBX), "an FBX file"),
    "empty folder": (Path.mkdir, "a folder without"),
}
BACKGROUNDS: dict[str, tuple[str, Content, str]] = {
    "cut picture": ("a.png", cut_file("photo.png", 0.5), "no readable picture"),
    "cut photo": ("a.jpg", cut_file("photo.jpg", 0.5), "no readable picture"),
    "text as a picture": ("a.png", BVH, "no readable picture"),
    "bomb": ("a.png", picture_of(60_000, 60_000), "3600000000 pixels"),
    "wrong pixels": ("a.png", picture_of(40, 30), "no readable picture"),
    "cut film": ("a.mkv", cut_file("film.mkv", 0.1), "no "),
    "text as a film": ("a.mp4", BVH, "found text"),
    "sound alone": ("a.wav", sound_only, "no video stream"),
    "folder without pictures": ("a", folder_of(), "no pictures"),
    "folder of broken pictures": ("a", folder_of(a=b"\x89PNG\r\n\x1a\n"), "no readable picture"),
}
BODIES: dict[str, tuple[Content, str]] = {
    "a motion": (arrays(), "a motion, which `trilane run --motion` takes"),
    "cut": (cut_file("body.npz", 0.6), "no readable .npz archive"),
    "no weights": (body(weights=None), "no array 'weights'"),
    "54 joints": (body(weights=body_arrays()["weights"][:, :54]), "shape (60, 54)"),
    "nan": (body(v_template=np.full((60, 3), np.nan)), "NaN or infinity"),
    "weights of two": (body(weights=body_arrays()["weights"] * 2), "a sum of 2"),
    "face out of range": (body(f=body_arrays()["f"] + 60), "indices from"),
    "a joint above itself": (body(kintree_table=np.zeros((2, 55), int) + 1), "a cycle"),
}
SCENES: dict[str, tuple[Content, str]] = {
    "cut": ("[output\nwidth = 3", "no valid TOML"),
    "unknown key": ("fraems = 3", "fraems: found an unknown key"),
    "a word for a number": ('frames = "many"', "frames: found 'many'"),
    "no number": ("fps = nan", "fps: found nan"),
    "nested": ("frames = " + "[" * 5000, "no valid TOML"),
    "twice": ("frames = 3\nframes = 4\n", "no valid TOML"),
}
NETWORKS: dict[str, tuple[Content, str]] = {
    "text": (BVH, "bytes that do not parse"),
    "cut": (cut_file("network.onnx", 0.5), "expected"),
    "FBX": (FBX, "an FBX file"),
}
AVATARS: dict[str, tuple[Content, str]] = {
    "no manifest": (Path.mkdir, "manifest.json: found no such file"),
    "cut manifest": (avatar(lambda folder: (folder / "manifest.json").write_text("{")), "manifest.json"),
    "outside": (manifest(body="../../etc/passwd"), "outside the bundle"),
    "no network": (avatar(lambda folder: (folder / "network.onnx").unlink()), "no such file"),
    "cut texture": (avatar(lambda folder: (folder / "texture.npz").write_bytes(b"PK\x03\x04")), "no readable .npz"),
    "texture nan": (
        avatar(lambda folder: np.savez(folder / "texture.npz", texture=np.full((8, 8, 3), np.nan, np.float16))),
        "NaN or infinite texels",
    ),
    "scale of another network": (
        avatar(
            lambda folder: (folder / "manifest.json").write_text(
                (folder / "manifest.json").read_text().replace('"scale": 0.5', '"scale": 0.7')
            )
        ),
        "by the manifest",
    ),
}


def table() -> dict[str, tuple[Callable[[Path], None], str, Content, str]]:
    """Name -> reader, name of the file, its content, words of the reason."""
    found = {}
    for read, name in NAMES.items():
        for what, (content, words) in ANY_FILE.items():
            found[f"{name}: {what}"] = (read, name, content, words)
    for read in (MOTION, CAMERA, SCENE):
        for what, (content, words) in ANY_TEXT.items():
            found[f"{NAMES[read]}: {what}"] = (read, NAMES[read], content, words)
    for read, name, rows in (
        (MOTION, "a.bvh", BVH_FILES),
        (MOTION, "a.fbx", OF_NO_READER),
        (MOTION, "a.npy", ARRAY_FILES),
        (MOTION, "a.npz", AMASS_FILES),
        (MOTION, "a.pkl", PICKLES),
        (CAMERA, "a.txt", TABLES),
        (CAMERA, "a.json", NERF_FILES),
        (CAMERA, "model", MODELS),
        (BODY, "body.npz", BODIES),
        (SCENE, "a.toml", SCENES),
        (NETWORK, "a.onnx", NETWORKS),
        (AVATAR, "a", AVATARS),
    ):
        found |= {f"{name}: {what}": (read, name, content, words) for what, (content, words) in rows.items()}
    return found | {f"{row[0]}: {what}": (BACKGROUND, *row) for what, row in BACKGROUNDS.items()}


ROWS_OF_ALL = table()
#: What is told by content is usable, for something else than what it was given as.
OF_ANOTHER_KIND = {(MOTION, "motion"), (MOTION, "picture"), (CAMERA, "picture"), (BODY, "motion")}


def test_there_are_more_than_a_hundred() -> None:
    assert len(ROWS_OF_ALL) > 140


@pytest.mark.parametrize("case", ROWS_OF_ALL)
def test_it_is_refused_with_the_right_reason(case: str, tmp_path: Path) -> None:
    read, name, content, words = ROWS_OF_ALL[case]
    path = tmp_path / name
    if isinstance(content, str):
        content = content.encode()
    if isinstance(content, bytes):
        path.write_bytes(content)
    else:
        content(path)
    before = sorted(tmp_path.rglob("*")), open_files(tmp_path), threading.active_count()
    with pytest.raises(BadInputError) as refused:
        read(path)
    sentence = str(refused.value)
    assert words in sentence
    assert name in refused.value.where
    assert "\n" not in sentence and len(sentence) < 1000
    try:
        found = inspect_file(path)
    except BadInputError as error:
        assert words in str(error)
    else:
        assert (read, found.kind) in OF_ANOTHER_KIND or not found.usable
        assert found.what
    assert (sorted(tmp_path.rglob("*")), open_files(tmp_path), threading.active_count()) == before
