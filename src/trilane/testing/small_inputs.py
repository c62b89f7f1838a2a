"""One small, sound file of every kind that people bring, to inspect, to spoil and to mutate.

Rule: everything is made here, from the published layout of its format; nothing depends on the default avatar.
"""

from __future__ import annotations

import json
import pickle
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import av
import numpy as np
import onnx
from numpy.typing import NDArray
from PIL import Image

from trilane.avatars.bundle import write_bundle
from trilane.avatars.manifest import Manifest, network_entry
from trilane.avatars.network_file import check_network
from trilane.body.joints import JOINT_PARENTS, JOINTS
from trilane.scene.motion.motion import T_POSE
from trilane.testing.byte_network import net
from trilane.testing.camera_files import (
    Writer,
    kitti_text,
    write_colmap_binary,
    write_colmap_text,
    write_euroc,
    write_record3d,
    write_stray,
)

VERTICES, FACES, CORNERS = 60, 80, 90
#: Name, depth below the root, offset from its parent in centimetres.
BVH_JOINTS = (
    ("Hips", 0, "0 95 0"),
    ("Spine", 1, "0 12 0"),
    ("Neck", 2, "0 38 0"),
    ("Head", 3, "0 12 1"),
    ("LeftArm", 2, "16 34 0"),
    ("LeftForeArm", 3, "28 0 0"),
    ("LeftHand", 4, "25 0 0"),
    ("RightArm", 2, "-16 34 0"),
    ("RightForeArm", 3, "-28 0 0"),
    ("RightHand", 4, "-25 0 0"),
    ("LeftUpLeg", 1, "9 -3 0"),
    ("LeftLeg", 2, "0 -42 0"),
    ("LeftFoot", 3, "0 -42 0"),
    ("RightUpLeg", 1, "-9 -3 0"),
    ("RightLeg", 2, "0 -42 0"),
    ("RightFoot", 3, "0 -42 0"),
)
FRAMES, STEP_S = 4, 1 / 30


def bvh_text(frames: int = FRAMES) -> str:
    """A person in a T pose whose left arm sinks by 10 degrees a frame; Mixamo's names, centimetres."""
    lines: list[str] = ["HIERARCHY"]
    depth = -1
    for name, level, offset in BVH_JOINTS:
        lines += _closed(depth, level)
        places = " Xposition Yposition Zposition" if not level else ""
        lines += [f"{'JOINT' if level else 'ROOT'} {name}", "{", f"OFFSET {offset}"]
        lines.append(f"CHANNELS {3 if level else 6}{places} Zrotation Xrotation Yrotation")
        depth = level
    lines += [*_closed(depth, 0), "MOTION", f"Frames: {frames}", f"Frame Time: {STEP_S:.6f}"]
    arm = [name for name, _, _ in BVH_JOINTS].index("LeftArm")
    for frame in range(frames):
        turns = np.zeros((len(BVH_JOINTS), 3))
        turns[arm, 0] = -10 * frame
        lines.append(" ".join(f"{value:g}" for value in (0.0, 95.0, frame, *turns.ravel())))
    return "\n".join(lines) + "\n"


def _closed(depth: int, level: int) -> list[str]:
    """Braces after a joint at `depth`, before one at `level`; the last of a chain has an end site."""
    if depth < level:
        return []
    return ["End Site", "{", "OFFSET 0 5 0", "}", *["}"] * (depth - level + 1)]


def poses(frames: int = FRAMES, joints: int = JOINTS) -> NDArray[np.float64]:
    """(T, joints * 3): stands, the left shoulder sinks."""
    array = np.zeros((frames, joints * 3))
    array[:, 48] = np.linspace(0, 0.3, frames)
    return array


def places_of_joints() -> NDArray[np.float64]:
    """(T, 22, 3): the first joints of a plain body in its T pose, which goes forward by a centimetre a frame."""
    forward = np.arange(FRAMES)[:, None, None] * np.array([0.0, 0.0, 0.01])
    return np.asarray(T_POSE[:22] + forward, np.float64)


def parts_of_poses() -> dict[str, NDArray[Any]]:
    """The poses as `smplx` names them: the pelvis, 21 joints, places."""
    array = poses()
    return {"global_orient": array[:, :3], "body_pose": array[:, 3:66], "transl": np.zeros((FRAMES, 3))}


def aist_arrays() -> dict[str, NDArray[Any]]:
    """The dict of an AIST++ file: 24 joints, places in its own unit and the scale of it."""
    return {"smpl_poses": poses(joints=24), "smpl_trans": np.ones((FRAMES, 3)), "smpl_scaling": np.array([90.0])}


def write_romp(path: Path) -> None:
    """A dict for each frame, in an array of one object, as ROMP saves a video."""
    frames = {
        f"{k:08}.png": {"smpl_thetas": poses(1, 24), "cam_trans": np.array([[0.0, 0.5, 3.0]]), "track_ids": [7]}
        for k in range(FRAMES)
    }
    with path.open("wb") as file:
        save: Any = np.savez
        save(file, results=np.array(frames, dtype=object))


def camera_poses(count: int = 5) -> list[tuple[NDArray[np.float64], NDArray[np.float64]]]:
    """Turns (3, 3) and places (3,) of a camera that moves to the right and turns left by 2 degrees a step; Y up."""
    found = []
    for k in range(count):
        c, s = np.cos(np.radians(2 * k)), np.sin(np.radians(2 * k))
        found.append((np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]]), np.array([0.1 * k, 1.5, 3.0])))
    return found


def camera_arrays() -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """`camera_poses` as two arrays."""
    turns, places = zip(*camera_poses(), strict=True)
    return np.stack(turns), np.stack(places)


def arkit_text() -> str:
    rows = [np.column_stack([turn, place]).ravel() for turn, place in camera_poses()]
    return "".join(f"{k / 30:.6f} {' '.join(f'{v:.6f}' for v in row)}\n" for k, row in enumerate(rows))


def tum_text() -> str:
    """Optical axes, Z up: the camera looks along +Y of the world."""
    half = np.sqrt(0.5)
    return "# time tx ty tz qx qy qz qw\n" + "".join(
        f"{1.3e9 + k / 30:.4f} {0.1 * k:.4f} 0 1.5 {-half:.6f} 0 0 {half:.6f}\n" for k in range(5)
    )


def nerf_text() -> str:
    frames = []
    for k in range(5):
        matrix = np.eye(4)
        matrix[:3, :3] = [[1, 0, 0], [0, 0, -1], [0, 1, 0]]
        matrix[:3, 3] = 0.1 * k, -3, 1.5
        frames.append({"file_path": f"images/{k}.png", "transform_matrix": matrix.tolist()})
    return json.dumps({"camera_angle_x": 0.9, "w": 640, "h": 480, "frames": frames}, indent=1)


def body_arrays(seed: int = 11) -> dict[str, NDArray[Any]]:
    """The arrays of a body file: vertices about a person's height, one to four weights each."""
    random = np.random.default_rng(seed)
    vertices = random.uniform((-0.4, -1.2, -0.2), (0.4, 0.5, 0.2), (VERTICES, 3))
    weights = np.zeros((VERTICES, JOINTS))
    for row in weights:
        row[random.choice(JOINTS, random.integers(1, 5), replace=False)] = 1.0
    weights /= weights.sum(axis=1, keepdims=True)
    regressor = random.uniform(0, 1, (JOINTS, VERTICES)) ** 8
    floats = {
        "v_template": vertices,
        "shapedirs": random.normal(0, 0.01, (VERTICES, 3, 20)),
        "posedirs": np.zeros((VERTICES, 3, 486)),
        "J_regressor": regressor / regressor.sum(axis=1, keepdims=True),
        "weights": weights,
        "vt": random.uniform(0, 1, (CORNERS, 2)),
        "hands_componentsl": np.eye(45),
        "hands_componentsr": np.eye(45),
        "hands_meanl": np.zeros(45),
        "hands_meanr": np.zeros(45),
    }
    integers = {
        "f": random.integers(0, VERTICES, (FACES, 3)),
        "ft": random.integers(0, CORNERS, (FACES, 3)),
        "kintree_table": np.array([np.array(JOINT_PARENTS) % 2**32, range(JOINTS)]),
    }
    arrays: dict[str, NDArray[Any]] = {key: value.astype(np.float32) for key, value in floats.items()}
    return arrays | {key: value.astype(np.uint32) for key, value in integers.items()}


def picture(seed: int = 0, width: int = 48, height: int = 36) -> Image.Image:
    """Smooth colours, other ones for each seed."""
    y, x = np.mgrid[0:height, 0:width]
    channels = [127 + 120 * np.sin(x / (5 + seed) + k) * np.cos(y / 7 + seed) for k in range(3)]
    return Image.fromarray(np.stack(channels, axis=-1).astype(np.uint8))


def write_film(path: Path, frames: int = 6) -> None:
    """Motion JPEG in Matroska, MP4 or AVI by the ending; 25 frames per second."""
    with av.open(str(path), "w") as container:
        stream = container.add_stream("mjpeg", rate=25)
        stream.width, stream.height, stream.pix_fmt = 48, 36, "yuvj420p"
        for k in range(frames):
            container.mux(stream.encode(av.VideoFrame.from_image(picture(k))))
        container.mux(stream.encode())


def write_avatar(folder: Path) -> None:
    """A bundle of the small body and a network of two convolutions."""
    body = folder.with_name("body-of-avatar.npz")
    _packed(body, **body_arrays())
    network = check_network(net(), "network.onnx")
    texture = np.random.default_rng(2).normal(0, 1, (8, 8, network.channels)).astype(np.float16)
    manifest = Manifest(name="small", network=network_entry(network, "resnet18", "batch", 8))
    write_bundle(folder, manifest, body, texture, network)
    body.unlink()


SCENE = """\
name = "small"
fps = 30.0
frames = 3
background = "photo.png"

[output]
width = 96
height = 64

[camera]
source = "tum.txt"

[[avatars]]
motion = "walk.bvh"
position = [0.0, 0.0, 0.5]
"""


def write_pictures(folder: Path) -> None:
    folder.mkdir()
    for k in range(3):
        picture(k).save(folder / f"{k:03}.png")


def _in_folder(write: Writer, path: Path) -> None:
    path.mkdir()
    write(path, *camera_arrays())


def _arrays(path: Path, **arrays: Any) -> None:
    np.savez(path, **arrays)


def _packed(path: Path, **arrays: Any) -> None:
    np.savez_compressed(path, **arrays)


#: Name of a file or folder -> what writes it.
WRITERS: dict[str, Callable[[Path], object]] = {
    "walk.bvh": lambda path: path.write_text(bvh_text()),
    "poses.npy": lambda path: np.save(path, poses()),
    "amass.npz": lambda path: _arrays(
        path, poses=poses(joints=52), trans=np.zeros((FRAMES, 3)), mocap_framerate=np.array(60.0), betas=np.zeros(10)
    ),
    "parts.npz": lambda path: _arrays(path, **parts_of_poses()),
    "aist.pkl": lambda path: path.write_bytes(pickle.dumps(aist_arrays(), protocol=4)),
    "romp.npz": write_romp,
    "places.npy": lambda path: np.save(path, places_of_joints()),
    "arkit.txt": lambda path: path.write_text(arkit_text()),
    "tum.txt": lambda path: path.write_text(tum_text()),
    "transforms.json": lambda path: path.write_text(nerf_text()),
    "euroc.csv": lambda path: write_euroc(path.parent, *camera_arrays()).rename(path),
    "kitti.txt": lambda path: path.write_text(kitti_text(*camera_arrays())),
    "metadata.json": lambda path: write_record3d(path.parent, *camera_arrays()),
    "odometry.csv": lambda path: write_stray(path.parent, *camera_arrays()),
    "colmap": partial(_in_folder, write_colmap_text),
    "colmap-binary": partial(_in_folder, write_colmap_binary),
    "photo.png": lambda path: picture().save(path),
    "photo.jpg": lambda path: picture().save(path),
    "film.mkv": write_film,
    "body.npz": lambda path: _packed(path, **body_arrays()),
    "network.onnx": lambda path: onnx.save(net(), path),
    "scene.toml": lambda path: path.write_text(SCENE),
    "pictures": write_pictures,
    "avatar": write_avatar,
}


def write_small_inputs(folder: Path, *names: str) -> dict[str, Path]:
    """Write the files and folders `names`, all of WRITERS if none, into `folder`; where each is."""
    for name in names or WRITERS:
        WRITERS[name](folder / name)
    return {name: folder / name for name in names or WRITERS}
