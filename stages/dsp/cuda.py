"""ONNX Runtime on an NVIDIA GPU. Rule: the whole graph runs on the GPU or nothing does; no node falls back to the CPU.

ONNX Runtime has no integer layers for CUDA: a layer's sum is computed in float, from the same bytes to the same bytes.
A slot is copied to the GPU and back, which `bind` cannot spare: its memory is not the GPU's.
"""

from __future__ import annotations

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
    """Compile `network` for the GPU; `options.device`: the provider's own settings.

    Raises BadInputError when a node of it does not run there, MissingPartError when there is no GPU that works.
    """
    _check_gpu()
    check_integer_layers(network)
    settings = onnxruntime.SessionOptions()
    settings.log_severity_level = ERRORS_ONLY
    settings.add_session_config_entry("session.disable_cpu_ep_fallback", "1")
    provider = (PROVIDER, dict(options.device))
    try:
        session = onnxruntime.InferenceSession(network.model.SerializeToString(), settings, providers=[provider])
    except LOAD_ERRORS as error:
        raise BadInputError(network.where, str(error), "a network that runs on the GPU as a whole") from error
    return OrtSession(session)


@cache
def _check_gpu() -> None:
    """Raises MissingPartError when the provider cannot be made: without it ONNX Runtime goes on without a word."""
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
