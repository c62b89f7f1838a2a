"""One small, sound file of every kind that people bring, to inspect, to spoil and to mutate.

Rule: everything is made here, from the published layout of its format; nothing depends on the default avatar. At the
end stand a network of bytes whose every part has a name, the folder of a small capture, and a manifest with figures
that are made up and digests that are real.
"""

from __future__ import annotations

import json
import pickle
from collections.abc import Callable
from datetime import date
from functools import partial
from pathlib import Path
from typing import Any

import av
import numpy as np
import onnx
from numpy.typing import NDArray
from onnx import TensorProto, helper, numpy_helper
from PIL import Image

from support.camera_files import (
    Writer,
    kitti_text,
    write_colmap_binary,
    write_colmap_text,
    write_euroc,
    write_record3d,
    write_stray,
)
from trilane.avatars.bundle import Bundle, write_bundle
from trilane.avatars.manifest import Manifest, Validation, digests_of, network_entry, with_figures_digest
from trilane.avatars.network_file import check_network
from trilane.body.joints import JOINT_PARENTS, JOINTS
from trilane.scene.motion.motion import T_POSE

VERTICES, FACES, CORNERS = 60, 80, 90
#: Vertices and faces of the skin of the small body.
SKIN = (52, 64)
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
    """The arrays of a body file: vertices about a person's height, one to four weights each; the last are a garment."""
    random = np.random.default_rng(seed)
    vertices = random.uniform((-0.4, -1.2, -0.2), (0.4, 0.5, 0.2), (VERTICES, 3))
    weights = np.zeros((VERTICES, JOINTS))
    for row in weights:
        row[random.choice(JOINTS, random.integers(1, 5), replace=False)] = 1.0
    weights /= weights.sum(axis=1, keepdims=True)
    regressor = random.uniform(0, 1, (JOINTS, VERTICES)) ** 8
    regressor[:, SKIN[0] :] = 0
    faces = random.integers(0, VERTICES, (FACES, 3))
    faces[: SKIN[1]] %= SKIN[0]
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
        "f": faces,
        "skin": np.array(SKIN),
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


def net(
    shape: tuple[int, ...] = (1, 32, 64, 3),
    out: tuple[int, ...] | None = None,
    scales: tuple[float, float] = (0.5, 0.25),
    zeros: tuple[int, int] = (7, 11),
) -> onnx.ModelProto:
    """NHWC bytes -> dequantise -> transpose -> 1x1 convolution -> quantise (middle) -> ... -> transpose -> bytes."""
    out = (*shape[:3], 4) if out is None else out
    rng = np.random.default_rng(3)
    constants = {
        "in_scale": np.float32(scales[0]), "in_zero": np.uint8(zeros[0]),
        "out_scale": np.float32(scales[1]), "out_zero": np.uint8(zeros[1]),
        "mid_scale": np.float32(0.125), "mid_zero": np.uint8(100),
        "w_scale": np.float32(0.01), "w_zero": np.int8(0),
        "w1": rng.integers(-100, 100, (4, shape[-1], 1, 1)).astype(np.int8),
        "w2": rng.integers(-100, 100, (4, 4, 1, 1)).astype(np.int8),
    }  # fmt: skip
    make = helper.make_node
    nodes = [
        make("DequantizeLinear", ["bytes", "in_scale", "in_zero"], ["real"], "bytes_in"),
        make("Transpose", ["real"], ["nchw"], "to_nchw", perm=[0, 3, 1, 2]),
        make("DequantizeLinear", ["w1", "w_scale", "w_zero"], ["w1_real"], "w1_in"),
        make("Conv", ["nchw", "w1_real"], ["conv1"], "conv1"),
        make("QuantizeLinear", ["conv1", "mid_scale", "mid_zero"], ["mid_q"], "mid_out"),
        make("DequantizeLinear", ["mid_q", "mid_scale", "mid_zero"], ["mid"], "mid_in"),
        make("DequantizeLinear", ["w2", "w_scale", "w_zero"], ["w2_real"], "w2_in"),
        make("Conv", ["mid", "w2_real"], ["conv2"], "conv2"),
        make("QuantizeLinear", ["conv2", "out_scale", "out_zero"], ["rgba_q"], "bytes_out"),
        make("Transpose", ["rgba_q"], ["rgba"], "to_nhwc", perm=[0, 2, 3, 1]),
    ]
    graph = helper.make_graph(
        nodes,
        "net",
        [helper.make_tensor_value_info("bytes", TensorProto.UINT8, shape)],
        [helper.make_tensor_value_info("rgba", TensorProto.UINT8, out)],
        [numpy_helper.from_array(np.asarray(value), name) for name, value in constants.items()],
    )
    return helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=8)


def node_of(model: onnx.ModelProto, name: str) -> onnx.NodeProto:
    """The node of that name. Raises StopIteration."""
    return next(node for node in model.graph.node if node.name == name)


HEIGHT, WIDTH = 64, 96
CAMERA = f"[camera]\nwidth = {WIDTH}\nheight = {HEIGHT}\nfx = 90.0\nfy = 80.0\ncx = 50.0\ncy = 30.0\n"


def fit(number: int, of: int = 8) -> dict[str, Any]:
    """Of frame `number` of `of`: the body turns about its own axis before an OpenGL camera, by the names of SMPL-X."""
    rng = np.random.default_rng(number)
    return {
        "global_orient": np.array([0.0, -2 * np.pi * number / of, 0.0]),
        "body_pose": rng.normal(0, 0.2, 63),
        "transl": np.array([0.1, 0.2, -3.0]),
        "betas": np.full(10, 0.1 * number),
    }


def write_capture_folder(folder: Path, frames: int = 8, head: str = "") -> Path:
    """The folder of a capture without faults, whose frames show all sides."""
    for part in ("frames", "masks", "fits"):
        (folder / part).mkdir(parents=True)
    text = f"schema = 1\n{head}\n{CAMERA}axes = 'opengl'\n"
    (folder / "capture.toml").write_text(text, encoding="utf-8")
    for number in range(frames):
        rng = np.random.default_rng((7, number))
        frame = rng.integers(0, 255, (HEIGHT, WIDTH, 3), dtype=np.uint8)
        mask = np.zeros((HEIGHT, WIDTH), np.uint8)
        mask[10:50, 30 + number : 60] = 255
        Image.fromarray(frame).save(folder / "frames" / f"{number:03}.png")
        Image.fromarray(mask).save(folder / "masks" / f"{number:03}.png")
        np.savez(folder / "fits" / f"{number:03}.npz", **fit(number, frames))
    return folder


#: Of the made-up figures, PSNR in dB: that of the avatar's runtime, and of `openvino`.
PSNR_DB, OTHER_PSNR_DB = 31.4159, 27.1828


def validated(bundle: Bundle, size: str = "256") -> Manifest:
    """The manifest of `bundle` with a validation of its files on `ort` and `openvino` at tensor size `size`."""
    figures = {
        "psnr_db_by_band": {"full_body": PSNR_DB},
        "psnr_db_by_background": {"black": PSNR_DB},
        "see_through": 0.0123,
        "iou": 0.9753,
        "ssim": 0.8642,
    }
    others = {
        "openvino": figures
        | {"psnr_db_by_band": {"full_body": OTHER_PSNR_DB}, "psnr_db_by_background": {"black": OTHER_PSNR_DB}}
    }
    digests = digests_of(bundle.folder, bundle.manifest)
    about = {"date": date(2026, 1, 2), "digests": digests, "runtime": "ort", "size": size, "other_runtimes": others}
    validation = with_figures_digest(Validation.model_validate(figures | about))
    return bundle.manifest.model_copy(update={"validation": validation})
