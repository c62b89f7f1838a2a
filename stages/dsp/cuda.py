"""The runtime `cuda`: ONNX Runtime on an NVIDIA GPU.

Rule: every node of the graph runs on the GPU. If a node cannot run there, loading fails; no node falls back to the CPU.

ONNX Runtime has no integer layers for CUDA: it computes a layer's sums in float, and only the layer's input and output
are bytes. Slots are copied to the GPU and back in every run, because the GPU cannot read their memory directly.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import cache

import onnxruntime
from onnx import TensorProto, helper

from trilane.avatars.network_file import IntegerNetwork, check_integer_layers
from trilane.errors import BadInputError, MissingPartError
from trilane.stages.dsp.ort import ERRORS_ONLY, LOAD_ERRORS, OrtSession
from trilane.stages.dsp.runtime import RuntimeOptions, cuda_line

PROVIDER = "CUDAExecutionProvider"
PROBE_OPSET, PROBE_IR = 17, 8
SILENT = 4


def load(network: IntegerNetwork, options: RuntimeOptions) -> OrtSession:
    """Return `network` compiled for the GPU.

    `options`: its `device` has settings of the CUDA provider.

    Raises BadInputError if a layer has no integers or a node does not run on the GPU, MissingPartError if no GPU works.
    """
    _check_gpu()
    check_integer_layers(network)
    return OrtSession(gpu_session(network.where, network.model.SerializeToString(), options.device))


def gpu_session(where: str, model: str | bytes, device: Mapping[str, str]) -> onnxruntime.InferenceSession:
    """Return a session on the GPU.

    `where`: name of the network in errors.
    `model`: path of the network's file, or the bytes of the file.
    `device`: settings of the CUDA provider.

    Raises BadInputError if a node does not run on the GPU, MissingPartError if no GPU works.
    """
    _check_gpu()
    settings = onnxruntime.SessionOptions()
    settings.log_severity_level = ERRORS_ONLY
    settings.add_session_config_entry("session.disable_cpu_ep_fallback", "1")
    try:
        return onnxruntime.InferenceSession(model, settings, providers=[(PROVIDER, dict(device))])
    except LOAD_ERRORS as error:
        raise BadInputError(where, str(error), "a network that runs on the GPU as a whole") from error


@cache
def _check_gpu() -> None:
    """Raise MissingPartError if the CUDA provider cannot be loaded. ONNX Runtime itself raises no error for this."""
    values = [helper.make_tensor_value_info(name, TensorProto.UINT8, [1]) for name in ("x", "y")]
    graph = helper.make_graph([helper.make_node("Identity", ["x"], ["y"])], "probe", values[:1], values[1:])
    probe = helper.make_model(graph, opset_imports=[helper.make_opsetid("", PROBE_OPSET)], ir_version=PROBE_IR)
    settings = onnxruntime.SessionOptions()
    settings.log_severity_level = SILENT
    session = onnxruntime.InferenceSession(probe.SerializeToString(), settings, providers=[PROVIDER])
    if PROVIDER not in session.get_providers():
        raise MissingPartError("ONNX Runtime found no NVIDIA GPU with CUDA and cuDNN", cuda_line())


def version() -> str:
    return f"onnxruntime {onnxruntime.__version__} for CUDA"
