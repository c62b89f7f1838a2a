"""The runtime `qnn`: Qualcomm's HTP through ONNX Runtime, on the Hexagon of a Snapdragon or its emulator on x86 Linux.

Rule: every node of the graph runs on the HTP. If a node cannot run there, loading fails; no node falls back to the CPU.
"""

from __future__ import annotations

import contextlib
import hashlib
from collections.abc import Mapping
from functools import cache
from pathlib import Path
from typing import Any

import onnxruntime
import onnxruntime_qnn

from trilane import machine
from trilane.avatars.network_file import IntegerNetwork, NetworkFile, check_integer_layers
from trilane.cache import cache_entry
from trilane.errors import BadInputError, MissingPartError
from trilane.stages.dsp.ort import ERRORS_ONLY, LOAD_ERRORS, OrtSession
from trilane.stages.dsp.runtime import RuntimeOptions
from trilane.writing import write_atomically

NAME = onnxruntime_qnn.get_ep_name()
#: Snapdragon 888: SoC number in Qualcomm's SDK, Hexagon v68.
SOCS = {"sm8350": {"soc_model": "30", "htp_arch": "68"}}
DEFAULTS = {**SOCS["sm8350"], "htp_performance_mode": "burst"}


def load(network: IntegerNetwork, options: RuntimeOptions) -> OrtSession:
    """Return `network` compiled for the HTP, from the cache if it was compiled before.

    Raises BadInputError if a node does not run on the HTP in integers, MissingPartError without an HTP.
    """
    check_integer_layers(network)
    device = {**DEFAULTS, **options.device}
    source, compiled = network.model.SerializeToString(), cache_entry("qnn", f"{_key(network, device)}.onnx")
    if compiled is None:
        return OrtSession(htp_session(network.where, source, device, {}))
    with contextlib.suppress(OSError, BadInputError):  # a missing or damaged file: the network is compiled again
        return OrtSession(htp_session(network.where, compiled.read_bytes(), device, {}))
    with write_atomically(compiled) as draft:
        session = htp_session(network.where, source, device, _context(draft))
    return OrtSession(session)


def write_context(network: NetworkFile, soc: str, path: Path) -> None:
    """Write `network`, compiled for `soc`, as an ONNX file at `path` that embeds the HTP's context binary.

    Raises BadInputError for an unknown `soc`, a file that cannot be written, or a network that does not run on the HTP
    in integers. Raises MissingPartError without an HTP.
    """
    if soc not in SOCS:
        raise BadInputError("soc", repr(soc), f"one of {', '.join(SOCS)}")
    check_integer_layers(network)
    with write_atomically(path) as draft:
        htp_session(network.where, network.model.SerializeToString(), SOCS[soc], _context(draft))


def version() -> str:
    return f"onnxruntime-qnn {onnxruntime_qnn.__version__}"


def _key(network: IntegerNetwork, device: Mapping[str, str]) -> str:
    """Return a file name that depends on everything that a compiled network depends on."""
    parts = (
        network.digest,
        version(),
        machine.here.architecture(),
        *(f"{key}={device[key]}" for key in sorted(device)),
    )
    return hashlib.sha256("\n".join(parts).encode()).hexdigest()


def _context(path: Path) -> dict[str, str]:
    """Return session entries that make ONNX Runtime write the compiled network to `path`."""
    return {"ep.context_enable": "1", "ep.context_embed_mode": "1", "ep.context_file_path": str(path)}


def htp_session(where: str, model: str | bytes, device: Mapping[str, str], entries: Mapping[str, str]) -> Any:
    """Return a session on the HTP.

    `where`: name of the network in errors.
    `model`: path of the network's file, or the bytes of the file.
    `device`: settings of the QNN provider.
    `entries`: further entries of the session's configuration.

    Raises BadInputError if a node does not run on the HTP, MissingPartError without an HTP.
    """
    settings = onnxruntime.SessionOptions()
    settings.log_severity_level = ERRORS_ONLY
    settings.add_provider_for_devices(_devices(), {"backend_path": onnxruntime_qnn.get_qnn_htp_path(), **device})
    for key, value in {"session.disable_cpu_ep_fallback": "1", **entries}.items():
        settings.add_session_config_entry(key, value)
    try:
        return onnxruntime.InferenceSession(model, settings)
    except LOAD_ERRORS as error:
        raise BadInputError(where, str(error), "a network that runs on the HTP as a whole") from error


@cache
def _devices() -> list[Any]:
    onnxruntime.register_execution_provider_library(NAME, onnxruntime_qnn.get_library_path())
    found = [device for device in onnxruntime.get_ep_devices() if device.ep_name == NAME]
    if not found:
        raise MissingPartError("no HTP device, real or emulated", extra="qnn")
    return found[:1]
