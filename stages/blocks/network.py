"""A network as a stage: `onnx = "net.onnx"` of a pipeline file, in ONNX Runtime, which reads and writes the slots.

Rule: an input that has the network's type is read where it lies, and an output is written where it is read; nothing is
copied. A picture is prepared first, into memory of the stage's own, as the block `prepare` does it. A newest frame that
is not there counts as zeros.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import onnxruntime
from numpy.typing import NDArray

from trilane.errors import BadInputError
from trilane.pipeline.file_keys import TYPES, PortType, port_type
from trilane.pipeline.ports import Arrays, PortedStage
from trilane.pipeline.stage import UnitContext
from trilane.stages.blocks.prepare import Preparation
from trilane.stages.dsp.ort import LOAD_ERRORS, PROVIDER, settings_of
from trilane.stages.dsp.runtime import RuntimeOptions


class _Fed(NamedTuple):
    """An input of the network.

    `own`: memory of the stage's own, which a prepared picture or zeros lie in.
    `preparation`: how a picture gets there; None where the slot is read as it is.
    """

    name: str
    type: PortType
    own: NDArray[Any]
    preparation: Preparation | None


class Network(PortedStage):
    """Runs one inference for a frame.

    Keys: `onnx`, and `inputs`: the type of each input of the network, by name, in its order.
    Raises BadInputError for a network that ONNX Runtime does not load.
    """

    def __init__(self, settings: Mapping[str, Any], options: RuntimeOptions) -> None:
        super().__init__(settings)
        keys, path = self.settings.keys, self.settings.folder / self.settings.keys["onnx"]
        self._session = _session(path, options)
        wanted = {name: port_type(text) for name, text in keys["inputs"].items()}
        self._fed = [self._fed_by(each.name, each.type, wanted) for each in self.reads]
        outputs = [each.name for each in self._session.get_outputs()]
        written = [name or outputs[0] for name in self.writes]
        self._unread = [name for name in outputs if name not in written]
        self._bindings: dict[tuple[int, ...], Any] = {}

    def _fed_by(self, port: str, found: PortType, wanted: Mapping[str, PortType]) -> _Fed:
        name = port or next(iter(wanted))
        own = np.zeros(wanted[name].shape, TYPES[wanted[name].dtype])
        is_same = found.dtype == wanted[name].dtype and math.prod(found.shape) == math.prod(wanted[name].shape)
        preparation = None if is_same else Preparation(found, wanted[name], {}, self.settings.where)
        return _Fed(name, wanted[name], own, preparation)

    def ready(self) -> None:
        """Run once on zeros: the first run of a session allocates its memory."""
        outputs = self._outputs[0] if self._outputs else {}
        self.work(0, [None] * len(self._fed), outputs)
        for array in outputs.values():
            array[...] = 0

    def work(self, frame: int, arrays: Sequence[NDArray[Any] | None], outputs: Arrays) -> Mapping[str, float]:  # noqa: ARG002
        sources = []
        for fed, array in zip(self._fed, arrays, strict=True):
            if array is None:
                fed.own[...] = 0
            elif fed.preparation is not None:
                fed.preparation.into(array, fed.own)
            sources.append(fed.own if array is None or fed.preparation is not None else array)
        places = tuple(each.ctypes.data for each in (*sources, *outputs.values()))
        if (binding := self._bindings.get(places)) is None:
            binding = self._bindings[places] = self._bound(sources, outputs)
        self._session.run_with_iobinding(binding)
        return {}

    def _bound(self, sources: Sequence[NDArray[Any]], outputs: Arrays) -> Any:
        binding = self._session.io_binding()
        for fed, array in zip(self._fed, sources, strict=True):
            binding.bind_input(fed.name, "cpu", 0, array.dtype, fed.type.shape, array.ctypes.data)
        for name, array in outputs.items():
            output = name or self._session.get_outputs()[0].name
            binding.bind_output(output, "cpu", 0, array.dtype, array.shape, array.ctypes.data)
        for name in self._unread:
            binding.bind_output(name, "cpu")
        return binding


def _session(path: Path, options: RuntimeOptions) -> onnxruntime.InferenceSession:
    try:
        return onnxruntime.InferenceSession(str(path), settings_of(options), providers=[PROVIDER])
    except LOAD_ERRORS as error:
        raise BadInputError(path, str(error), "a network that ONNX Runtime loads") from error


def build(settings: Mapping[str, Any], unit: UnitContext) -> Network:
    """Build the stage. Raises BadInputError."""
    return Network(settings, RuntimeOptions(unit.settings.threads, unit.settings.spin))
