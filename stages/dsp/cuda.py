"""ONNX Runtime on an NVIDIA GPU. Rule: the whole graph runs on the GPU or nothing does; no node falls back to the CPU.

ONNX Runtime has no integer layers for CUDA: a layer's sum is computed in float, from the same bytes to the same bytes.
A slot is copied to the GPU and back, which `bind` cannot spare: its memory is not the GPU's.
"""

from __future__ import annotations

import onnxruntime

from trilane.avatars.network_file import IntegerNetwork, check_integer_layers
from trilane.errors import BadInputError, MissingPartError
from trilane.stages.dsp.ort import ERRORS_ONLY, LOAD_ERRORS, OrtSession
from trilane.stages.dsp.runtime import RUNTIMES, RuntimeOptions

PROVIDER = "CUDAExecutionProvider"


def load(network: IntegerNetwork, options: RuntimeOptions) -> OrtSession:
    """Compile `network` for the GPU; `options.device`: the provider's own settings.

    Raises BadInputError when a node of it does not run there, MissingPartError when there is no GPU that works.
    """
    check_integer_layers(network)
    settings = onnxruntime.SessionOptions()
    settings.log_severity_level = ERRORS_ONLY
    settings.add_session_config_entry("session.disable_cpu_ep_fallback", "1")
    provider = (PROVIDER, dict(options.device))
    try:
        session = onnxruntime.InferenceSession(network.model.SerializeToString(), settings, providers=[provider])
    except LOAD_ERRORS as error:
        raise BadInputError(network.where, str(error), "a network that runs on the GPU as a whole") from error
    if PROVIDER not in session.get_providers():
        raise MissingPartError("CUDA found no GPU that works", RUNTIMES["cuda"].install)
    return OrtSession(session)


def version() -> str:
    return f"onnxruntime {onnxruntime.__version__} for CUDA"
