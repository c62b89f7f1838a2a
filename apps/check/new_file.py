"""Writes a runnable pipeline file for networks on a video. Sizes and rate are read from the video and the networks.

Each network has its own branch, which gets every frame of the video. A stage `prepare` makes the network's input, and a
stage `discard` takes the output. Further stages, in comments, would write a video of the output. The user can edit the
file to join the branches.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from itertools import count
from pathlib import Path

import av

from trilane.apps.check.port_types import NETWORK_CHANNELS, port_types, read_networks, require_weights, value_type
from trilane.errors import BadInputError, TrilaneError
from trilane.hw_profiles.graph_file import fed_inputs, read_graph
from trilane.pipeline.description import LONGEST_NAME, quoted
from trilane.pipeline.file_keys import PortType
from trilane.pipeline.pipeline_file import read_pipeline
from trilane.stages.gpu.video_reader import open_video, require_video
from trilane.writing import write_bytes

A_VIDEO = "a video that PyAV reads"
LONGEST_ENDING = len("-video")  # longest text that is added to a network's name in the name of a stage
ON_A_CHIP = "on a chip, each block but discard needs time_ms = MS, or scale = { CHIP = FACTOR } and --measured RUN"


def write_new_file(
    out: Path,
    networks: Sequence[Path],
    video: Path,
    unit: str = "dsp",
    shapes: Mapping[str, tuple[int, ...]] | None = None,
) -> str:
    """Write the pipeline file `out`, and return its text.

    `networks`: ONNX files. `video`: video file. Networks and video must lie in the folder of `out`, or below it.
    `unit`: unit of all networks: cpu, gpu or dsp.
    `shapes`: shapes of inputs whose sizes the networks leave open, by the input's name; None for no such inputs.

    Raises BadInputError if `out` exists, if a network or the video cannot be read, or if one of them lies elsewhere.
    Raises it also for a network that takes no picture or has no weights. After an error, no new file is left.
    """
    if out.exists():
        raise BadInputError(out, "a file that exists", "another name, as nothing is overwritten")
    folder = out.resolve().parent
    width, height, rate = _video(video)
    lines = [
        f"# networks over a video: {len(networks)}; docs/pipeline-file.md has every key",
        f"# {ON_A_CHIP}",
        "[run]",
        f"fps = {rate:g}",
        "[stages]",
        f'camera = {{ block = "video", unit = "cpu", path = {_inside(video, folder)}, size = "{width}x{height}" }}',
    ]
    names = {"camera"}
    for network in networks:
        lines += _branch(network, folder, unit, names, shapes or {})
    text = "\n".join(lines) + "\n"
    write_bytes(out, text.encode())
    try:
        file = read_pipeline(out)
        port_types(file, read_networks(file))
    except TrilaneError:
        out.unlink()
        raise
    return text


def _branch(
    network: Path, folder: Path, unit: str, names: set[str], shapes: Mapping[str, tuple[int, ...]]
) -> list[str]:
    """Return the lines of a network's branch in the pipeline file.

    `network`: ONNX file. `folder`: folder of the pipeline file. `unit`: unit of the network. `names`: names of all
    stages so far, to which the names of this branch are added. `shapes`: as in `write_new_file`.

    Raises BadInputError for a network that `write_new_file` refuses.
    """
    graph = read_graph(network, dict(shapes))
    require_weights(graph, network)
    inputs = [_picture_input(network, value.name, value_type(value)) for value in fed_inputs(graph)]
    endings = [f"-in{place}" if len(inputs) > 1 else "-in" for place in range(len(inputs))]
    name = _free_name(network.stem, ("", *endings, "-out", "-drawn", "-video"), names)
    prepared = [name + ending for ending in endings]
    lines = []
    for stage, port in zip(prepared, inputs, strict=True):
        of = f", port = {quoted(port)}" if len(inputs) > 1 else ""
        lines.append(f'{stage} = {{ block = "prepare", unit = "cpu", in = "camera", like = "{name}"{of} }}')
    reads = f'"{prepared[0]}"'
    if len(inputs) > 1:
        reads = "{ " + ", ".join(f'{quoted(p)} = "{s}"' for s, p in zip(prepared, inputs, strict=True)) + " }"
    open_sizes = {port: "x".join(map(str, shapes[port])) for port in inputs if port in shapes}
    known = ", ".join(f"{quoted(port)} = {quoted(sizes)}" for port, sizes in open_sizes.items())
    given = f", shapes = {{ {known} }}" if known else ""
    lines.append(f'{name} = {{ onnx = {_inside(network, folder)}, unit = "{unit}", in = {reads}{given} }}')
    first = graph.model.graph.output[0]
    found = quoted(f"{name}.{first.name}")
    lines.append(f'{name}-out = {{ block = "discard", unit = "cpu", in = {found} }}')
    return lines + [f"# {line}" for line in _video_of(name, found, value_type(first))]


def _free_name(stem: str, endings: Sequence[str], names: set[str]) -> str:
    """Return a free name for the stage of a network, and add the names of its branch to `names`.

    The name is `stem`, cut to fit, with `-` for special characters. If a name of the branch is taken, a number follows.
    `stem`: name of the network file without ending. `names`: names that are taken.
    `endings`: for each stage of the branch, the text that follows the returned name in the stage's name.
    """
    head = re.sub(r"[^\w-]", "-", stem, flags=re.ASCII) or "network"
    for number in count(1):
        mark = f"-{number}" if number > 1 else ""
        name = head[: LONGEST_NAME - LONGEST_ENDING - len(mark)] + mark
        branch = {name + ending for ending in endings}
        if not branch & names:
            break
    names |= branch
    return name


def _video_of(name: str, found: str, of: PortType | None) -> list[str]:
    """Return a line of explanation, and the lines of two stages that write a video of a network's output.

    If the block `overlay` cannot draw the output, the result is one line with advice instead. `name`: stage of the
    network. `found`: `STAGE.OUTPUT`, quoted. `of`: type of this output; None if no port can carry it.
    """
    shape = of.shape if of is not None else ()
    is_plane = len(shape) == 4 and sum(size > 1 for size in shape) in (2, 3)
    port = "mask" if is_plane else "boxes" if shape[-1:] in ((4,), (5,)) else ""
    if not port:
        return [
            f"{name} finds {of or 'no numbers'}: a stage with python makes a mask or boxes of it for overlay and encode"
        ]
    frame = f'{{ frame = "camera", {port} = {found} }}'
    return [
        f"for a video of what {name} finds ({port}, or depth), take the # from the next two lines",
        f'{name}-drawn = {{ block = "overlay", unit = "cpu", in = {frame} }}',
        f'{name}-video = {{ block = "encode", unit = "cpu", in = "{name}-drawn", path = "{name}-video.mp4" }}',
    ]


def _picture_input(network: Path, name: str, of: PortType | None) -> str:
    """Return `name`, the name of an input of `network`. Raises BadInputError if this input takes no picture.

    `of`: type of the input; None if no port can carry it.
    """
    shape = of.shape if of is not None else ()
    if len(shape) != 4 or not {shape[1], shape[3]} & set(NETWORK_CHANNELS):
        expected = "a picture, 1xCxHxW or 1xHxWxC with 1 or 3 channels"
        remedy = "write the stages before it by hand (docs/pipeline-file.md)"
        raise BadInputError(f"{network}: input {name!r}", str(of or "no numbers"), expected, remedy)
    return name


def _inside(path: Path, folder: Path) -> str:
    """Return `path` relative to `folder`, in TOML's quotes. Raises BadInputError for a path outside of `folder`."""
    absolute = Path(path.parent.resolve() / path.name)
    if not absolute.is_relative_to(folder):
        remedy = f"write the file into {absolute.parent}, or put a link to {path.name} into {folder}"
        raise BadInputError(path, f"a file outside of {folder}", "one in the folder of the pipeline file", remedy)
    return quoted(absolute.relative_to(folder).as_posix())


def _video(path: Path) -> tuple[int, int, float]:
    """Return the width and height of a video in pixels, and its rate in frames a second (30 if unknown).

    Raises BadInputError for a file that PyAV cannot read, or that has no video.
    """
    require_video(path)
    try:
        with open_video(path) as container:
            stream = container.streams.video[0]
            return stream.width, stream.height, round(float(stream.average_rate or stream.guessed_rate or 30), 3)
    except (av.FFmpegError, IndexError, ValueError) as error:
        raise BadInputError(path, f"no video: {error}", A_VIDEO) from None
