"""The types of a pipeline file's ports: stated by the file, defined by its networks, or implied by its blocks.

    types = port_types(file, read_networks(file))
    types["camera"][""].shape  # (480, 640, 3)

The key "" is the port of a block with one output, or of a stage whose key `out` is one type without a name.

Rule: the type of a port of the user's own code may be unknown. If the types at both ends of a connection are known,
they must fit each other.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import onnx

from trilane.errors import BadInputError, did_you_mean
from trilane.hw_profiles.graph_file import GraphFile, fed_inputs, read_graph
from trilane.pipeline.file_keys import (
    TYPES,
    BlockStage,
    BusyBlock,
    DiscardBlock,
    EncodeBlock,
    OnnxStage,
    OverlayBlock,
    PortInput,
    PortType,
    PrepareBlock,
    PythonStage,
    StageKeys,
    TimedStage,
    VideoBlock,
)
from trilane.pipeline.pipeline_file import PipelineFile
from trilane.stages.blocks.pictures import Preparation

#: Types of the ports that a stage writes, by port, by stage. A stage whose types are unknown is absent.
PortTypes = dict[str, dict[str, PortType]]
CODES = {name: code for code, name in TYPES.items()}
PICTURE_CHANNELS = (1, 3, 4)
NETWORK_CHANNELS = (1, 3)
A_WHOLE_NETWORK = "a network with its weights"
BARE_REMEDY = "export it with its weights; `trilane check` and `trilane predict` take it as it is"


def read_networks(file: PipelineFile) -> dict[str, GraphFile]:
    """Return the network of each stage with an ONNX file, by the stage's name.

    Raises BadInputError if a network cannot be read, or if an input of a network gets no stream. Raises it also if the
    file names a port that a network lacks.
    """
    found = {}
    for name, stage in file.stages.items():
        if isinstance(stage, OnnxStage):
            found[name] = _read(file, name, stage)
            _check_names(file, name, stage, found[name])
    for name, stage in file.stages.items():
        for each in stage.inputs:
            if each.stage in found:
                _check_output(file, name, each, [one.name for one in found[each.stage].model.graph.output])
    return found


def require_weights(graph: GraphFile, where: str | Path) -> None:
    """Raise BadInputError if a weight of the network has no values, because no runtime can run such a network.

    `graph`: network. `where`: place that the message names: a key of the pipeline file, or the network file.
    """
    held = {each.name for each in graph.model.graph.initializer} | {each.name for each in fed_inputs(graph)}
    if bare := [value.name for value in graph.model.graph.input if value.name not in held]:
        without = f"{graph.path.name} without weights: {len(bare)} are inputs without values"
        raise BadInputError(where, without, A_WHOLE_NETWORK, BARE_REMEDY)
    tensors = onnx.load(graph.path, load_external_data=False).graph.initializer
    stored = [entry.value for tensor in tensors for entry in tensor.external_data if entry.key == "location"]
    if absent := [name for name in stored if not (graph.path.parent / name).is_file()]:
        without = f"{graph.path.name} without weights: they are in {absent[0]}, which is not there"
        raise BadInputError(where, without, A_WHOLE_NETWORK, f"put {absent[0]} beside it, or {BARE_REMEDY}")


def _read(file: PipelineFile, name: str, stage: OnnxStage) -> GraphFile:
    where = f"{file.path}: stages.{name}"
    try:
        return read_graph(file.folder / stage.onnx, stage.shapes)
    except BadInputError as error:
        found = re.sub(r"--input-shape (\S+)=", r"shapes.\1 = ", error.found)
        remedy = re.sub(r"give it: --input-shape (\S+)=([\dxN]+)", r"add shapes = { \1 = '\2' }", error.remedy)
        raise BadInputError(f"{where}.onnx: {error.where}", found, error.expected, remedy) from None


def _check_names(file: PipelineFile, name: str, stage: OnnxStage, graph: GraphFile) -> None:
    """Raise BadInputError if an input of the network of stage `name` gets no stream, or if a key names no input.

    The keys are `in` and `shapes`. A stream may also feed an input that stands for a weight. Raises BadInputError also
    as `_check_fixed` does. `file`: pipeline file.
    `stage`: keys of the stage. `graph`: network of the stage.
    """
    where, inputs = f"{file.path}: stages.{name}", [value.name for value in graph.model.graph.input]
    wanted = [value.name for value in fed_inputs(graph)]
    for shape in stage.shapes:
        if shape not in inputs:
            expected = f"one of {', '.join(inputs)}"
            hint = did_you_mean(shape, inputs) or "leave it out"
            raise BadInputError(f"{where}.shapes.{shape}", "an unknown input", expected, hint)
    if stage.shapes:
        _check_fixed(where, stage, onnx.load(file.folder / stage.onnx, load_external_data=False).graph)
    ports = [each.port for each in stage.inputs]
    if ports == [""] and len(wanted) == 1:
        return
    for port in ports:
        if port not in inputs:
            found = f"the unknown port {port!r}" if port else "a stage without a port"
            expected = f"a table with {', '.join(wanted)}"
            remedy = did_you_mean(port, wanted) or "name each of its inputs there"
            raise BadInputError(f"{where}.in", found, expected, remedy)
    for each in wanted:
        if each not in ports:
            found = f"nobody who feeds the input {each!r} of {stage.onnx}"
            remedy = f'add {each} = "STAGE" to the table in' if ports else 'add in = "STAGE"'
            raise BadInputError(f"{where}.in", found, f"a stage for each of {', '.join(wanted)}", remedy)


def _check_fixed(where: str, stage: OnnxStage, graph: onnx.GraphProto) -> None:
    """Raise BadInputError if the key `shapes` changes a size that the network fixes. No runtime accepts such a change.

    `where`: place of the stage in the pipeline file, for the message. `stage`: keys of the stage. `graph`: network of
    the stage, without the changes of `shapes`.
    """
    for value in graph.input:
        own = [size.dim_value for size in value.type.tensor_type.shape.dim]
        given = stage.shapes.get(value.name, ())
        if any(size not in (0, asked) for size, asked in zip(own, given, strict=False)):
            found, expected = ("x".join(str(size or "N") for size in sizes) for sizes in (given, own))
            remedy = "leave it out, or export the network with open sizes"
            raise BadInputError(f"{where}.shapes.{value.name}", found, f"{expected}, as the network fixes it", remedy)


def _check_output(file: PipelineFile, name: str, each: PortInput, outputs: list[str]) -> None:
    """Raise BadInputError if an input of stage `name` reads an output that the network of another stage lacks.

    `file`: pipeline file. `each`: the input. `outputs`: names of the network's outputs.
    """
    where = f"{file.path}: stages.{name}.in" + (f".{each.port}" if each.port else "")
    if each.from_port and each.from_port not in outputs:
        found = f"the unknown port {each.from_port!r} of {each.stage}"
        hint = did_you_mean(each.from_port, outputs) or f"write {each.stage}.OUTPUT"
        raise BadInputError(where, found, f"one of {', '.join(outputs)}", hint)


def port_types(file: PipelineFile, networks: Mapping[str, GraphFile]) -> PortTypes:
    """Return the types of all ports whose type is known: name of the stage -> name of the port -> type.

    `file`: pipeline file. `networks`: result of `read_networks`.

    Raises BadInputError if a stage cannot read a port because of the port's type. Raises it also if the first stage of
    the bypass lacks a port that the last stage reads.
    """
    found: PortTypes = {}
    for name, stage in file.stages.items():
        _check_inputs(file, name, stage, found, networks)
        known = _written(stage, found, networks.get(name), networks)
        if known:
            found[name] = known
    _check_bypass(file, found)
    return found


def _check_bypass(file: PipelineFile, types: PortTypes) -> None:
    """Raise BadInputError if the first stage of the bypass lacks a port that the last stage of the bypass reads.

    A port of the right name and another type counts as lacking. A port is not checked if its type is unknown, or if
    all types of the first stage are unknown. Of a block `overlay`, only the frame is checked. No port is needed if the
    last stage is Python code, a stage with a set time, or a block `busy` or `discard`. `file`: pipeline file.
    `types`: types of all known ports.
    """
    if file.bypass is None:
        return
    begin, way = file.bypass
    stage, given = file.stages[way.to], types.get(begin)
    if given is None or isinstance(stage, PythonStage | TimedStage | BusyBlock | DiscardBlock):
        return
    for each in stage.inputs:
        known = source_type(each, types)
        is_needed = not isinstance(stage, OverlayBlock) or each.port in ("", "frame")
        port = each.from_port or next(iter(types.get(each.stage, {"": None})))
        if is_needed and known is not None and given.get(port) != known:
            where, named = f"{file.path}: stages.{begin}.bypass.to", f"the port {port}" if port else "a port"
            found = f"{way.to!r}, which needs {named} with {known} also from {begin}"
            remedy = f"or a stage with python there, which gets None where {begin} does not write the port"
            raise BadInputError(where, found, f"{begin} with this port", remedy)


def _written(
    stage: StageKeys, known: PortTypes, network: GraphFile | None, networks: Mapping[str, GraphFile]
) -> dict[str, PortType]:
    """Return the types of the ports that a stage writes, by port; empty if they are unknown.

    `stage`: keys of the stage. `known`: types of the earlier stages' ports. `network`: network of the stage; None for a
    stage without a network.
    `networks`: networks of all stages, by stage.
    """
    if stage.out is not None:
        return stage.out
    if network is not None:
        outputs = {value.name: value_type(value) for value in network.model.graph.output}
        return {name: each for name, each in outputs.items() if each is not None}
    if isinstance(stage, VideoBlock):
        return {"": PortType("u8", (stage.size[1], stage.size[0], 3))}
    if isinstance(stage, PrepareBlock):
        inputs = fed_inputs(networks[stage.like])
        chosen = [value for value in inputs if stage.port in ("", value.name)]
        wanted = value_type(chosen[0]) if len(chosen) == 1 else None
        return {"": wanted} if wanted else {}
    if isinstance(stage, OverlayBlock):
        frame = next(each for each in stage.inputs if each.port in ("", "frame"))
        picture = source_type(frame, known)
        return {"": picture} if picture else {}
    return {}


def source_type(each: PortInput, known: PortTypes) -> PortType | None:
    """Return the type of the port that the input `each` reads; None for an unknown type. `known`: all known types."""
    ports = known.get(each.stage, {})
    if each.from_port:
        return ports.get(each.from_port)
    return next(iter(ports.values())) if len(ports) == 1 else None


def value_type(value: onnx.ValueInfoProto) -> PortType | None:
    """Return the type of a network's input or output; None if no port can carry its kind of numbers.

    A size that the network leaves open is 0. A single number has the shape (1,).
    """
    kind = value.type.tensor_type
    try:
        name = np.dtype(onnx.helper.tensor_dtype_to_np_dtype(kind.elem_type)).name
    except KeyError:
        return None
    shape = tuple(size.dim_value for size in kind.shape.dim)
    return PortType(CODES[name], shape or (1,)) if name in CODES else None


def is_picture(port: PortType) -> bool:
    """Return whether a port carries a picture: bytes of shape (height, width, channels) with 1, 3 or 4 channels."""
    return port.dtype == "u8" and len(port.shape) == 3 and port.shape[2] in PICTURE_CHANNELS


def _check_inputs(
    file: PipelineFile, name: str, stage: StageKeys, known: PortTypes, networks: Mapping[str, GraphFile]
) -> None:
    """Raise BadInputError if stage `name` cannot read a port, because of the type of this port.

    `file`: pipeline file. `stage`: keys of the stage. `known`: types of the known ports of earlier stages.
    `networks`: networks of all stages, by stage.
    """
    for each in stage.inputs:
        found = source_type(each, known)
        if found is None:
            continue
        where = f"{file.path}: stages.{name}.in" + (f".{each.port}" if each.port else "")
        takes_picture = isinstance(stage, PrepareBlock | EncodeBlock) or (
            isinstance(stage, OverlayBlock) and each.port in ("", "frame")
        )
        if takes_picture and not is_picture(found):
            remedy = "read a stage that writes pictures; overlay draws masks, depth and boxes on one"
            raise BadInputError(where, f"{found} from {each.stage}", "a picture, such as u8 480x640x3", remedy)
        if isinstance(stage, PrepareBlock) and (wanted := _written(stage, known, None, networks)):
            keys = stage.model_dump(include=set(PrepareBlock.model_fields) - set(BlockStage.model_fields))
            Preparation(next(iter(wanted.values())), keys, f"{file.path}: stages.{name}")
        if name in networks:
            _check_network(where, found, each, networks[name])


def _check_network(where: str, found: PortType, each: PortInput, network: GraphFile) -> None:
    """Raise BadInputError if a network cannot take a port of type `found` as its input.

    A network takes a port with numbers of the same kind and count, whatever their shape. An input for pictures takes
    other pictures too, if they can be prepared. `where`: place in the pipeline file, for the message. `each`: input of
    the stage that reads the port. `network`: network of this stage.
    """
    inputs = network.model.graph.input if each.port else fed_inputs(network)
    value = next(one for one in inputs if each.port in ("", one.name))
    wanted = value_type(value)
    if wanted is None or (found.dtype == wanted.dtype and math.prod(found.shape) == math.prod(wanted.shape)):
        return
    if is_picture(found) and len(wanted.shape) == 4 and {wanted.shape[1], wanted.shape[3]} & set(NETWORK_CHANNELS):
        Preparation(wanted, {}, where)
        return
    prepared = 'a block = "prepare" before it' if is_picture(found) else f"a stage that writes {wanted}"
    remedy = f"add {prepared}"
    raise BadInputError(where, f"{found} from {each.stage}", f"{wanted} for the input {value.name!r}", remedy)
