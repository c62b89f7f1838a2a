"""Qualcomm's HTP backend through ONNX Runtime: the Hexagon of a Snapdragon, or its emulator on x86 Linux.

Rule: the whole graph runs on the HTP or nothing does; no node falls back to the CPU.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import cache
from pathlib import Path
from typing import Any

import onnxruntime
import onnxruntime_qnn

from trilane.avatars.network_file import NetworkFile, check_integer_layers
from trilane.errors import BadInputError, MissingPartError
from trilane.stages.dsp.ort import ERRORS_ONLY, LOAD_ERRORS, OrtSession
from trilane.stages.dsp.runtime import RuntimeOptions

NAME = onnxruntime_qnn.get_ep_name()
#: Snapdragon 888: SoC number of Qualcomm's SDK, Hexagon v68.
SOCS = {"sm8350": {"soc_model": "30", "htp_arch": "68"}}
DEFAULTS = {**SOCS["sm8350"], "htp_performance_mode": "burst"}


def load(network: NetworkFile, options: RuntimeOptions) -> OrtSession:
    """Compile `network` for the HTP. Raises BadInputError when a node of it does not run there in integers."""
    check_integer_layers(network)
    return OrtSession(_session(network, {**DEFAULTS, **options.device}, {}))


def write_context(network: NetworkFile, soc: str, path: Path) -> None:
    """Write `network` compiled for `soc` as an ONNX file that embeds the HTP context binary. Raises BadInputError."""
    if soc not in SOCS:
        raise BadInputError("soc", repr(soc), f"one of {', '.join(SOCS)}")
    check_integer_layers(network)
    context = {"ep.context_enable": "1", "ep.context_embed_mode": "1", "ep.context_file_path": str(path)}
    _session(network, SOCS[soc], context)


def version() -> str:
    return f"onnxruntime-qnn {onnxruntime_qnn.__version__}"


def _session(network: NetworkFile, device: Mapping[str, str], entries: Mapping[str, str]) -> Any:
    settings = onnxruntime.SessionOptions()
    settings.log_severity_level = ERRORS_ONLY
    settings.add_provider_for_devices(_devices(), {"backend_path": onnxruntime_qnn.get_qnn_htp_path(), **device})
    for key, value in {"session.disable_cpu_ep_fallback": "1", **entries}.items():
        settings.add_session_config_entry(key, value)
    try:
        return onnxruntime.InferenceSession(network.model.SerializeToString(), settings)
    except LOAD_ERRORS as error:
        raise BadInputError(network.where, str(error), "a network that runs on the HTP as a whole") from error


@cache
def _devices() -> list[Any]:
    onnxruntime.register_execution_provider_library(NAME, onnxruntime_qnn.get_library_path())
    found = [device for device in onnxruntime.get_ep_devices() if device.ep_name == NAME]
    if not found:
        raise MissingPartError("no HTP device, real or emulated", "pip install 'trilane[qnn]'")
    return found[:1]
