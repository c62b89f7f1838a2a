"""The runtime `ort`: ONNX Runtime on the CPU, which reads and writes the slots' own memory.

Rule: after the first run of a session nothing is allocated and nothing is copied. Only the layers in `float_layers` of
the network may run in float.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import onnx
import onnxruntime
from numpy.typing import NDArray
from onnxruntime.capi import onnxruntime_pybind11_state as state

from trilane.arrays import U8
from trilane.avatars.network_file import IntegerNetwork, node_name
from trilane.errors import BadInputError
from trilane.stages.dsp.runtime import RuntimeOptions

PROVIDER = "CPUExecutionProvider"
FLOAT_LAYERS = {"Conv", "FusedConv", "NhwcFusedConv", "ConvTranspose", "Gemm", "FusedGemm", "MatMul", "FusedMatMul"}
LOAD_ERRORS = (
    state.Fail,
    state.InvalidProtobuf,
    state.EPFail,
    state.InvalidArgument,
    state.InvalidGraph,
    state.NotImplemented,
    state.RuntimeException,
)
ERRORS_ONLY = 3
Named = Mapping[str, NDArray[Any]]


class OrtBinding:
    """An ONNX Runtime IOBinding to arrays by name; an output without an array goes to memory of the runtime."""

    def __init__(self, session: onnxruntime.InferenceSession, inputs: Named, outputs: Named) -> None:
        self._buffers = (*inputs.values(), *outputs.values())
        self._session = session
        self._io = session.io_binding()
        for name, array in inputs.items():
            self._io.bind_input(name, "cpu", 0, array.dtype, array.shape, array.ctypes.data)
        for name, array in outputs.items():
            self._io.bind_output(name, "cpu", 0, array.dtype, array.shape, array.ctypes.data)
        for each in session.get_outputs():
            if each.name not in outputs:
                self._io.bind_output(each.name, "cpu")

    def run(self) -> None:
        self._session.run_with_iobinding(self._io)


class OrtSession:
    """One session, which has its own threads. `outputs`: names of the network's outputs, in order."""

    def __init__(self, session: onnxruntime.InferenceSession) -> None:
        self._session = session
        self._inputs = [each.name for each in session.get_inputs()]
        self.outputs: Sequence[str] = [each.name for each in session.get_outputs()]

    def bind(self, inputs: Sequence[U8], outputs: Sequence[U8]) -> OrtBinding:
        return OrtBinding(
            self._session, dict(zip(self._inputs, inputs, strict=True)), dict(zip(self.outputs, outputs, strict=True))
        )

    def bound(self, inputs: Named, outputs: Named) -> Callable[[], object]:
        return OrtBinding(self._session, inputs, outputs).run


def load(network: IntegerNetwork, options: RuntimeOptions) -> OrtSession:
    """Return `network` compiled for the threads of `options`.

    Raises BadInputError if ONNX Runtime cannot load the network, or would run further layers in float than the
    network's `float_layers`.
    """
    with tempfile.TemporaryDirectory(prefix="trilane-ort-") as folder:
        optimised = Path(folder) / "optimised.onnx"
        settings = settings_of(options)
        settings.optimized_model_filepath = str(optimised)
        try:
            session = onnxruntime.InferenceSession(network.model.SerializeToString(), settings, providers=[PROVIDER])
        except LOAD_ERRORS as error:
            raise BadInputError(network.where, str(error), "a network that ONNX Runtime loads") from error
        check_integer(onnx.load(optimised), network)
    return OrtSession(session)


def version() -> str:
    return f"onnxruntime {onnxruntime.__version__}"


def check_integer(optimised: onnx.ModelProto, network: IntegerNetwork) -> None:
    """Raise BadInputError if `optimised` has further float layers than `float_layers` of `network`.

    The error names these layers. `optimised`: optimised graph of `network`.
    """
    layers = {node_name(node) for node in optimised.graph.node if node.op_type in FLOAT_LAYERS}
    float_layers = sorted(layers - network.float_layers)
    if float_layers:
        raise BadInputError(
            network.where, f"layers left in float: {', '.join(float_layers)}", "integer layers", "quantise them"
        )


def settings_of(options: RuntimeOptions) -> onnxruntime.SessionOptions:
    settings = onnxruntime.SessionOptions()
    settings.intra_op_num_threads = options.threads
    settings.inter_op_num_threads = 1
    settings.execution_mode = onnxruntime.ExecutionMode.ORT_SEQUENTIAL
    settings.log_severity_level = ERRORS_ONLY
    settings.add_session_config_entry("session.intra_op.allow_spinning", str(int(options.spin)))
    return settings
