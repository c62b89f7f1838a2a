"""Describes motions, cameras, pictures, bodies, avatars, networks, scenes and runs.

Rule: each file is read by the function that the other commands use. This function finds the facts and decides whether
the file is usable; this module only adds words. Nothing is placed in a scene. Therefore all facts are about the file
alone. Pictures and videos are read as backgrounds.
"""

from __future__ import annotations

import itertools
import json
import warnings
import zlib
from collections.abc import Sequence
from functools import cache, partial
from pathlib import Path
from typing import Any

import av
import numpy as np
from PIL import ExifTags, Image, ImageDraw

from trilane.apps.avatar_files import bundle_facts
from trilane.apps.compare.overview import read_entries
from trilane.apps.inspect.inspection import Inspection, Length, drawn_cameras, drawn_points, drawn_skeletons, used
from trilane.apps.run.report import REPORT_FILE, read_report
from trilane.apps.run.run_files import SHEET
from trilane.apps.sweep.definition import read_sweep
from trilane.avatars.bundle import DEFAULT, MANIFEST, bundle_folder, load_bundle
from trilane.avatars.network_file import read_network
from trilane.body.body import ShapedBody, load_body
from trilane.body.joints import Skeleton
from trilane.errors import BadInputError, reason
from trilane.files import HEAD_BYTES, read_bytes, read_npz, read_text
from trilane.hw_profiles.graph_file import read_graph
from trilane.hw_profiles.profile_files import load_profile
from trilane.pipeline.journal import NAME as JOURNAL
from trilane.pipeline.journal import read_journal
from trilane.pipeline.measurements.read_file import MOST_TRACE_BYTES
from trilane.pipeline.measurements.trace_slices import packets_in
from trilane.scene.camera.files import load_camera
from trilane.scene.camera.path import CameraPath
from trilane.scene.footage import Footage
from trilane.scene.motion.files import load_motion
from trilane.scene.motion.motion import Motion
from trilane.scene.recordings import Detected
from trilane.scene.rotations import matrix_from_quat
from trilane.scene.schema import AvatarSpec, CameraSpec, load_scene
from trilane.stages.gpu.background import MOST_PACKETS, is_picture, open_background, pictures_in, read_picture, survey
from trilane.stages.gpu.video_reader import open_video, quarters_of

MOMENTS = 6
MOST_PATH_POINTS = 2000


def inspect_body(path: Path) -> Inspection:
    """Describe a body file. Raises BadInputError if the body is not usable."""
    shaped = load_body(path).shape()
    height = float(np.ptp(shaped.vertices[:, 1]))
    facts = {
        "vertices": len(shaped.vertices),
        "triangles": len(shaped.body.faces),
        "joints": len(shaped.joints),
        "height_m": round(height, 4),
        "pose_blend_shapes": shaped.body.has_pose_blend_shapes,
    }
    return Inspection(
        "body",
        f"a body of {len(shaped.vertices)} vertices, {height:.2f} m tall",
        f"trilane body inspect {path}",
        Detected("body in the SMPL-X layout", "an array `v_template`", "Y up, as the layout has it", "m"),
        facts=facts,
        draw=partial(drawn_points, shaped.vertices),
    )


def inspect_avatar(path: Path) -> Inspection:
    """Describe an avatar. `path`: its bundle's folder or manifest. Raises BadInputError if the bundle is not usable."""
    folder = path if path.is_dir() else path.parent
    bundle = load_bundle(folder)
    found = bundle_facts(bundle)
    manifest = bundle.manifest
    vertices = bundle.shaped_body().vertices
    facts = {
        "name": found["name"],
        "vertices": found["body"]["vertices"],
        "texture": found["texture"]["shape"],
        "network": {key: found["network"][key] for key in ("file", "encoder", "width", "shape", "parameters", "gmac")},
        "validated": found["validation"] is not None,
    }
    return Inspection(
        "avatar",
        f"the avatar {manifest.name!r}",
        used("--avatar", folder),
        Detected("avatar bundle", f"a file {MANIFEST}"),
        facts=facts,
        draw=partial(drawn_points, vertices),
    )


def inspect_texture(path: Path) -> Inspection:
    """Describe a neural texture. Raises BadInputError if the file cannot be read."""
    shape = list(read_npz(path, ("texture",), "a neural texture")["texture"].shape)
    what = f"a neural texture of shape {tuple(shape)}, a part of an avatar"
    found = Detected("neural texture", "an array `texture`")
    return Inspection("texture", what, f"trilane inspect {path.parent}", found, facts={"shape": shape})


def inspect_network(path: Path) -> Inspection:
    """Describe an ONNX network. A network that no avatar can use is still usable for predictions.

    Raises BadInputError if the file is no ONNX network.
    """
    graph = read_graph(path)
    facts: dict[str, Any] = {"parameters": graph.work.weights, "gmac": graph.work.macs / 1e9, "numbers": graph.numbers}
    notes: tuple[str, ...] = ()
    try:
        shape = read_network(path).shape
        facts, what = {"avatars": True, "shape": list(shape), **facts}, "an avatar's integer network"
    except BadInputError as error:
        facts, what = {"avatars": False, **facts}, "an ONNX network, which is no avatar's"
        notes = (f"no avatar's network: found {error.found}, expected {error.expected}",)
    detected = Detected("ONNX network", "a protobuf message with nodes and operator sets")
    advice = f"trilane predict --network {path}"
    return Inspection("network", what, advice, detected, facts=facts, notes=notes)


def inspect_scene(path: Path) -> Inspection:
    """Describe a scene. The files that the scene names are not read. If one of them is missing, the scene is unusable.

    Raises BadInputError if the scene itself cannot be read.
    """
    values = load_scene(path)
    avatars = values["avatars"]
    named = [values["background"], values["camera"]["source"], *(raw["motion"] for raw in avatars)]
    facts = {"name": values["name"], "avatars": len(avatars), "sources": [str(source) for source in named]}
    missing = [source for source in facts["sources"] if "/" in source and not Path(source).exists()]
    notes = tuple(f"{source}: no such file, which the scene names" for source in missing)
    what = f"the scene {values['name']!r} with {len(avatars)} avatar{'s' if len(avatars) != 1 else ''}"
    advice = "give the files that it names" if missing else used("", path)
    found = Detected("scene", "TOML with keys of the scene schema")
    return Inspection("scene", what, advice, found, facts=facts, notes=notes, problem=notes[0] if missing else "")


def inspect_profile(path: Path) -> Inspection:
    """Describe a hardware profile. Raises BadInputError if the profile is not usable."""
    profile = load_profile(path)
    found = Detected("hardware profile", "TOML with a title and units")
    return Inspection(
        "hardware profile",
        f"the hardware profile of {profile.title}",
        f"trilane predict --profile {path}",
        found,
        facts={"name": profile.name},
    )


def inspect_run(path: Path) -> Inspection:
    """Describe a run by its report or, without a report, by its journal. `path`: folder or journal of the run.

    Raises BadInputError if this report or journal cannot be read.
    """
    folder = path if path.is_dir() else path.parent
    sheet = folder / SHEET
    detected = Detected("run folder", "a report or a journal in it")
    draw = partial(_copied, sheet) if sheet.is_file() else None
    if (folder / REPORT_FILE).is_file():
        found = inspect_report(folder)
        return Inspection("run", f"a run folder with {found.what}", found.advice, detected, found.length,
                          found.facts, draw=draw)  # fmt: skip
    records = sum(1 for _ in read_journal(folder / JOURNAL))
    what = f"a run folder without a report: a journal of {records} records of a run that goes on or was killed"
    return Inspection("run", what, f"trilane explain {folder}", detected, facts={"records": records}, draw=draw)


def _copied(sheet: Path) -> Image.Image:
    try:
        with Image.open(sheet) as image:
            return image.convert("RGB")
    except (OSError, ValueError, SyntaxError, Image.DecompressionBombError) as error:
        raise BadInputError(sheet, f"no readable picture ({error})", "the contact sheet of a run") from error


def inspect_report(path: Path) -> Inspection:
    """Describe the report of a run. Raises BadInputError if `path` is no report."""
    report = read_report(path)
    presented = report.frames.presented
    seconds = report.duration_s
    facts = {"clock": report.clock, "fps": report.fps, "presented": presented, "failure": report.failure}
    few = "one frame" if presented else "no frame"
    rate = few if report.fps is None else f"{presented} frames at {report.fps:.4g}/s"
    what = f"the report of {rate} on the {report.clock} clock"
    advice = f"trilane explain {path if path.is_dir() else path.parent}"
    length = Length(presented, float(seconds), report.fps)
    return Inspection("report", what, advice, Detected("report of a run", "its key `clock`"), length, facts)


def inspect_sweep(path: Path) -> Inspection:
    """Describe the folder of a sweep. Raises BadInputError if its trials are not readable."""
    entries = read_entries([path])
    what = f"a folder of {len(entries)} trials of a sweep"
    found = Detected("sweep", "a file trials.jsonl")
    return Inspection("sweep", what, f"trilane report {path}", found, facts={"trials": len(entries)})


def inspect_sweep_file(path: Path) -> Inspection:
    """Describe a sweep file. Raises BadInputError if `path` is no sweep file."""
    sweep = read_sweep(path)
    command = " ".join(sweep.command)
    facts = {"command": command, "axes": list(sweep.axes)}
    found = Detected("sweep file", "TOML with a `command`")
    return Inspection("sweep file", f"a sweep of `trilane {command}`", f"trilane sweep {path}", found, facts=facts)


def inspect_trace(path: Path) -> Inspection:
    """Describe a trace in Perfetto's or Chrome's format. Raises BadInputError if `path` is no trace."""
    events = _trace_events(path)
    found, advice = Detected("trace", "its events"), "open it at https://ui.perfetto.dev"
    return Inspection("trace", f"a trace of {events} events", advice, found, facts={"events": events})


def _trace_events(path: Path) -> int:
    with path.open("rb") as file:
        is_json = file.read(HEAD_BYTES).lstrip()[:1] in (b"{", b"[")
    if not is_json:
        return _packets(path)
    expected = "a trace in Chrome's format"
    try:
        document: Any = json.loads(read_text(path, expected))
    except (ValueError, RecursionError) as error:
        raise BadInputError(path, str(error), expected) from None
    events = document.get("traceEvents") if isinstance(document, dict) else None
    if not isinstance(events, list):
        raise BadInputError(f"{path}: traceEvents", type(events).__name__, "a list of events")
    return len(events)


def _packets(path: Path) -> int:
    from google.protobuf.message import DecodeError

    content = read_bytes(path, MOST_TRACE_BYTES, "a trace of Perfetto")
    try:
        count = sum(1 for _ in packets_in(content))
    except (DecodeError, zlib.error) as error:
        raise BadInputError(path, "bytes that do not parse", "a trace of Perfetto") from error
    if not count:
        raise BadInputError(path, "no packets", "a trace of Perfetto")
    return count


def inspect_motion(path: Path) -> Inspection:
    """Describe a motion file. Raises BadInputError if the motion is not usable."""
    motion = load_motion(AvatarSpec(motion=str(path.absolute())), Path(), _body().joints)
    places = motion.translation
    facts = {
        "travels": motion.travels,
        "ground_m": [round(float(side), 3) for side in np.ptp(places, axis=0)[[0, 2]]],
        "leg_m": None if motion.leg_m is None else round(motion.leg_m, 3),
        "betas": 0 if motion.betas is None else len(motion.betas),
    }
    return Inspection(
        "motion",
        f"a motion: {motion.detected.format or 'a recording'}",
        used("--motion", path),
        motion.detected,
        Length.of(motion.times_s),
        facts,
        motion.notes,
        partial(_drawn_motion, motion),
    )


def inspect_camera(path: Path) -> Inspection:
    """Describe a camera path. Raises BadInputError if the path is not usable."""
    camera = load_camera(CameraSpec(source=str(path.absolute())), Path())
    low, high = camera.places.min(axis=0), camera.places.max(axis=0)
    steps = np.linalg.norm(np.diff(camera.places, axis=0), axis=1)
    angles = [lens.fov_y_deg for lens in camera.optics.lenses]
    facts = {
        "fov_y_deg": [round(min(angles), 3), round(max(angles), 3)],
        "lenses": len(angles),
        "pictures": len(camera.pictures),
        "extent_m": [round(float(side), 3) for side in high - low],
        "path_m": round(float(steps.sum()), 3),
    }
    return Inspection(
        "camera",
        f"a camera path: {camera.detected.format or 'a recording'}",
        used("--camera", path),
        camera.detected,
        Length.of(camera.times_s),
        facts,
        camera.notes,
        partial(_drawn_camera, camera),
    )


@cache
def _body() -> ShapedBody:
    """Return the body of the default avatar, whose skeleton shows the motions."""
    return load_body(bundle_folder(DEFAULT) / "body.npz").shape()


def _drawn_motion(motion: Motion) -> Image.Image:
    body = _body()
    skeleton = Skeleton(body.joints, body.body.parents)
    times = np.linspace(0.0, motion.duration_s, MOMENTS if motion.duration_s else 1)
    joints = []
    for time_s in times:
        pose, place = motion.sample(float(time_s))
        joints.append(skeleton.pose(pose, place - body.joints[0]).joints.copy())
    return drawn_skeletons(np.stack(joints), times, _thinned(motion.translation))


def _drawn_camera(camera: CameraPath) -> Image.Image:
    return drawn_cameras(_thinned(matrix_from_quat(camera.quats)), _thinned(camera.places))


def _thinned(samples: np.ndarray) -> np.ndarray:
    """Return at most MOST_PATH_POINTS of `samples` (N, ...), evenly spread. The first and the last sample are kept."""
    if len(samples) <= MOST_PATH_POINTS:
        return samples
    return np.asarray(samples[np.linspace(0, len(samples) - 1, MOST_PATH_POINTS).round().astype(int)])


THUMB = (160, 213)  # height, width
COLUMNS, MOST_THUMBS = 4, 8
FOLDER_FPS = 30.0
DAMAGED = (OSError, ValueError, SyntaxError, Image.DecompressionBombError)


def inspect_picture(path: Path) -> Inspection:
    """Describe a picture. A file with several frames, such as a GIF, is described as a video.

    Raises BadInputError if the file cannot be a background.
    """
    if not is_picture(path) and _moves(path):
        return inspect_video(path)
    thumb = read_picture(path, THUMB)
    encoding, facts = picture_facts(path)
    return Inspection(
        "picture",
        f"a {encoding} picture of {facts['width']}x{facts['height']} pixels",
        used("--background", path),
        Detected(f"{encoding} picture", "the head of the file", axes=_turned(facts["exif_orientation"])),
        facts=facts,
        draw=partial(_sheet, [thumb], [path.name]),
    )


def _moves(path: Path) -> bool:
    """Return whether the picture file `path` has several frames."""
    try:
        with Image.open(path) as image:
            return bool(getattr(image, "is_animated", False))
    except DAMAGED:
        return False


def picture_facts(path: Path) -> tuple[str, dict[str, Any]]:
    """Return a picture's encoding, such as `PNG`, and its facts by name.

    The facts are `width` and `height` in pixels, Pillow's `mode`, and `exif_orientation` (1 to 8, 1 if not stated).
    Raises BadInputError for a file that is no readable picture.
    """
    try:
        with warnings.catch_warnings(action="ignore"), Image.open(path) as image:
            turn = image.getexif().get(ExifTags.Base.Orientation, 1)
            return str(image.format), {
                "width": image.width,
                "height": image.height,
                "mode": image.mode,
                "exif_orientation": int(turn) if isinstance(turn, int) and 1 <= turn <= 8 else 1,
            }
    except DAMAGED as error:
        raise BadInputError(path, f"no readable picture ({reason(error)})", "a picture") from error


def _turned(orientation: int) -> str:
    return "" if orientation == 1 else f"EXIF orientation {orientation}: turned or mirrored to be upright"


def inspect_folder(path: Path) -> Inspection:
    """Describe a folder of pictures. Raises BadInputError if a picture is not usable."""
    names, footage = pictures_in(path), survey(path, FOLDER_FPS)
    for name in names:
        read_picture(name, (8, 8))  # decodes the whole file, which shows damage
    sizes = sorted({(facts["width"], facts["height"]) for _, facts in map(picture_facts, names)})
    chosen = [names[k] for k in _spread(len(names))]
    first = f"{sizes[0][0]}x{sizes[0][1]}"
    return Inspection(
        "pictures",
        f"a folder of {len(names)} pictures of {first if len(sizes) == 1 else f'{len(sizes)} sizes'}",
        used("--background", path),
        Detected("folder of pictures", f"{len(names)} files end as pictures do", rate=_folder_rate(footage)),
        facts={
            "pictures": len(names),
            "first": names[0].name,
            "last": names[-1].name,
            "sizes": [list(s) for s in sizes],
        },
        draw=lambda: _sheet([read_picture(name, THUMB) for name in chosen], [name.name for name in chosen]),
    )


def _folder_rate(footage: Footage) -> str:
    """Return the rate of the pictures in words, followed by notes.

    If the pictures have no times, each frame of the scene takes one picture.
    """
    own = footage.rate if footage.clock_s else ("the scene's, one a frame", *footage.rate[1:])
    return "; ".join(own)


def inspect_video(path: Path) -> Inspection:
    """Describe a video. Raises BadInputError if the video cannot be a background."""
    footage = survey(path, FOLDER_FPS)
    try:
        with open_video(path) as container:
            stream = container.streams.video[0]
            pixels, codec = stream.format, stream.codec_context.name
            rate = float(stream.average_rate) if stream.average_rate else None
            bits = max((part.bits for part in pixels.components), default=8) if pixels else 8
            width, height, turn = stream.width, stream.height, _rotation(stream)
            seconds, stated = _seconds(container, stream), stream.frames
    except (av.FFmpegError, ValueError, OSError) as error:
        raise BadInputError(path, f"no readable video ({error})", "a video that FFmpeg can decode") from error
    frames = stated or _counted(path)
    turned = f", turned by {turn} degrees" if turn else ""
    return Inspection(
        "video",
        f"a video ({codec}) of {width}x{height} pixels{turned}",
        used("--background", path),
        Detected(f"{codec} video", "streams that FFmpeg finds", rate="; ".join((*footage.rate, *footage.what[1:]))),
        Length(frames, seconds, rate if stated or not seconds else frames / seconds),
        {"codec": codec, "width": width, "height": height, "rate_hz": rate, "bits": bits, "turned_deg": turn},
        draw=partial(_film, path, seconds),
    )


def _counted(path: Path) -> int:
    """Return the number of frames in a video file, counted up to MOST_PACKETS packets."""
    with open_video(path) as container:
        packets = container.demux(container.streams.video[0])
        return sum(packet.size > 0 for packet in itertools.islice(packets, MOST_PACKETS))


def _rotation(stream: Any) -> int:
    """Return the clockwise turn of a video's first frame, as the file states it, in degrees: 0, 90, 180 or 270.

    A video without frames gives 0.
    """
    for frame in stream.container.decode(stream):
        return 90 * quarters_of(frame)
    return 0


def _seconds(container: Any, stream: Any) -> float:
    if stream.duration:
        return float(stream.duration * stream.time_base)
    return float((container.duration or 0) / av.time_base)


def _film(path: Path, seconds: float) -> Image.Image:
    """Return a contact sheet of frames of the video `path`, at evenly spread times. `seconds`: length of the video.

    Raises BadInputError if no frame can be decoded.
    """
    background = open_background(path, THUMB, FOLDER_FPS)
    pictures, captions = [], []
    try:
        for time_s in np.linspace(0, max(seconds - 0.05, 0), MOST_THUMBS):
            picture = background.at(float(time_s))
            if picture is not None:
                pictures.append(picture)
                captions.append(f"{time_s:.2f} s")
    finally:
        background.close()
    if not pictures:
        raise BadInputError(path, "no frame that can be decoded", "a video that FFmpeg can decode")
    return _sheet(pictures, captions)


def _spread(count: int) -> list[int]:
    return sorted({int(k) for k in np.linspace(0, count - 1, min(count, MOST_THUMBS)).round()})


def _sheet(pictures: Sequence[Any], captions: Sequence[str]) -> Image.Image:
    height, width = THUMB
    columns = min(COLUMNS, len(pictures))
    sheet = Image.new("RGB", (columns * width, -(-len(pictures) // columns) * height))
    draw = ImageDraw.Draw(sheet)
    for place, (picture, caption) in enumerate(zip(pictures, captions, strict=True)):
        corner = (place % columns * width, place // columns * height)
        sheet.paste(Image.fromarray(picture), corner)
        draw.text((corner[0] + 4, corner[1] + 2), caption, fill="white", stroke_width=2, stroke_fill="black")
    return sheet
