"""A network as a stage: `onnx = "net.onnx"` of a pipeline file, in a runtime that reads and writes the slots.

Rule: an input that has the network's type is read where it lies, and an output is written where it is read; nothing is
copied. A picture is prepared first, into memory of the stage's own, as the block `prepare` does it. A newest frame that
is not there counts as zeros.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from trilane.pipeline.file_keys import TYPES, PortType, port_type
from trilane.pipeline.stage import Arrays, PortedStage, UnitContext
from trilane.stages.blocks.prepare import Preparation
from trilane.stages.dsp.any_network import engine_of
from trilane.stages.dsp.runtime import RuntimeOptions, has_device


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

    Keys: `onnx`, `runtime`, and `inputs`: the type of each input of the network, by name, in its order.
    Raises BadInputError for a network that the runtime does not load, MissingPartError for an absent runtime.
    """

    def __init__(self, settings: Mapping[str, Any], options: RuntimeOptions) -> None:
        super().__init__(settings)
        keys = self.settings.keys
        wanted = {name: port_type(text) for name, text in keys["inputs"].items()}
        shapes = {name: each.shape for name, each in wanted.items()}
        self._engine = engine_of(self.settings.folder / keys["onnx"], keys["runtime"], shapes, options)
        self._fed = [self._fed_by(each.name, each.type, wanted) for each in self.reads]
        self._calls: dict[tuple[int, ...], Callable[[], object]] = {}

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
        if (call := self._calls.get(places)) is None:
            call = self._calls[places] = self._bound(sources, outputs)
        call()
        return {}

    def _bound(self, sources: Sequence[NDArray[Any]], outputs: Arrays) -> Callable[[], object]:
        """Return the call from these inputs to these outputs."""
        given = {fed.name: array.reshape(fed.type.shape) for fed, array in zip(self._fed, sources, strict=True)}
        return self._engine.bound(given, {name or self._engine.outputs[0]: array for name, array in outputs.items()})


def build(settings: Mapping[str, Any], unit: UnitContext) -> Network:
    """Build the stage. Raises BadInputError, MissingPartError."""
    if has_device(settings["keys"]["runtime"]):
        unit.use_device(settings["keys"]["runtime"])
    return Network(settings, RuntimeOptions(unit.settings.threads, unit.settings.spin))
