"""The user's own code as a stage: `python = "module:factory"` of a pipeline file; and the blocks `busy` and `discard`.

`factory(settings)` is called once in the unit's process and returns a callable. The callable is called for each frame
with an array for each input: a named port as a keyword argument, a single input without a name as the only argument.
The argument of an input with `sync = "latest"` is None while it has no frame, or only one older than `max_age_ms`. The
callable returns a dict of arrays by port, or the array of the only port. If the callable has a parameter `out`, this
parameter gets the arrays to fill, by port, and the callable may return None.

If a bypass begins at the stage, the callable may have an attribute `skips`, which is read after each frame: true sends
the frame to the bypass. If the callable has a method `forget`, the method is called when the next frame must not rely
on earlier frames (`SkippingStage.forget`).

Rule: a returned array must have the type that the file states; nothing is cast or broadcast silently. An error says
which stage, file and line it comes from.

The block `busy` is an artificial load, and `discard` takes frames and does nothing with them.
"""

from __future__ import annotations

import inspect
import time
import traceback
from collections.abc import Callable, Mapping, Sequence
from importlib import import_module
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from trilane.errors import BadInputError, TrilaneError, did_you_mean
from trilane.pipeline.file_keys import TYPES, BypassKeys
from trilane.pipeline.stage import Arrays, PortedStage, Skip, UnitContext
from trilane.units import NS_PER_MS

OUT, SKIPS, FORGET = "out", "skips", "forget"


class OwnCode(PortedStage):
    """A stage that calls the user's own code.

    Raises BadInputError for an absent module or factory, or a factory that returns no callable. Raises TrilaneError if
    the user's module or factory fails.
    """

    def __init__(self, settings: Mapping[str, Any]) -> None:
        super().__init__(settings)
        name, _, factory = self.settings.keys["python"].partition(":")
        where = f"{self.settings.where}.python"
        self._module: ModuleType = self._guarded(_imported, name, where)
        made = getattr(self._module, factory, None)
        if not callable(made):
            known = [one for one, value in vars(self._module).items() if callable(value) and not one.startswith("_")]
            expected = f"one of {', '.join(known) or 'none'}"
            raise BadInputError(where, f"no function {factory!r} in {name}", expected, did_you_mean(factory, known))
        self._call: Callable[..., Any] = self._guarded(made, dict(self.settings.keys.get("settings", {})))
        if not callable(self._call):
            found = f"{factory} returned {type(self._call).__name__}"
            raise BadInputError(where, found, "something callable", "the factory returns a function for the frames")
        self._fills, self._may_skip = _takes_out(self._call), "bypass" in self.settings.keys

    def work(self, frame: int, arrays: Sequence[NDArray[Any] | None], outputs: Arrays) -> Mapping[str, float]:  # noqa: ARG002
        named = {each.name: array for each, array in zip(self.reads, arrays, strict=True) if each.name}
        plain = [array for each, array in zip(self.reads, arrays, strict=True) if not each.name]
        filled = {OUT: outputs} if self._fills else {}
        found = self._guarded(self._call, *plain, **named, **filled)
        if outputs and (found is not None or not self._fills):
            self._write(found, outputs)
        return Skip() if self._may_skip and getattr(self._call, SKIPS, False) else {}

    def forget(self) -> None:
        if callable(own := getattr(self._call, FORGET, None)):
            self._guarded(own)

    def _write(self, found: object, outputs: Arrays) -> None:
        """Copy `found`, the arrays that the code returned, to the output slot. Raises TrilaneError for other values."""
        if not isinstance(found, dict):
            found = dict.fromkeys(outputs, found) if len(outputs) == 1 else found
        self._check(found, outputs)
        assert isinstance(found, dict)
        for name, target in outputs.items():
            target[...] = found[name]

    def _check(self, found: object, outputs: Arrays) -> None:
        """Raise TrilaneError if `found`, the arrays by port, has other ports, types or shapes than the file states."""
        if not isinstance(found, dict) or found.keys() != outputs.keys():
            said = f"a dict of {', '.join(map(str, found))}" if isinstance(found, dict) else type(found).__name__
            ports = ", ".join(name or "one array" for name in outputs)
            raise TrilaneError(f"{self.settings.where}: its code returned {said}, expected {ports}")
        for name, target in outputs.items():
            array = found[name]
            if not isinstance(array, np.ndarray) or (array.dtype, array.shape) != (target.dtype, target.shape):
                port = f" for port {name}" if name else ""
                said = f"{_shown(array)}{port}, expected {_shown(target)}"
                raise TrilaneError(f"{self.settings.where}: its code returned {said}")

    def _guarded(self, call: Callable[..., Any], *args: Any, **named: Any) -> Any:
        """Return the result of `call`, the user's code. An error becomes a TrilaneError with stage, file and line."""
        try:
            return call(*args, **named)
        except TrilaneError:
            raise
        except Exception as error:
            traceback.print_exception(error)
            own = [each for each in traceback.extract_tb(error.__traceback__) if _is_own(each.filename)]
            at = f" at {own[-1].filename}, line {own[-1].lineno}" if own else ""
            raise TrilaneError(f"{self.settings.where}: {type(error).__name__}: {error}{at}") from error


def _imported(name: str, where: str) -> ModuleType:
    try:
        return import_module(name)
    except ModuleNotFoundError as error:
        missing = f"no module {error.name!r}"
        remedy = f"put {name}.py beside the pipeline file, or install it"
        raise BadInputError(where, missing, "a module of the file's folder or an installed one", remedy) from None


def _is_own(file: str) -> bool:
    """Return whether a file of a traceback is the user's code: not this file, and no part of the import machinery."""
    return Path(file) != Path(__file__) and not file.startswith("<") and "/importlib/" not in file


def _takes_out(call: Callable[..., Any]) -> bool:
    try:
        return OUT in inspect.signature(call).parameters
    except (TypeError, ValueError):
        return False


def _shown(array: object) -> str:
    if not isinstance(array, np.ndarray):
        return type(array).__name__
    code = next((code for code, name in TYPES.items() if name == array.dtype.name), array.dtype.name)
    return f"{code} {'x'.join(map(str, array.shape))}".strip()


def build(settings: Mapping[str, Any], unit: UnitContext) -> OwnCode:  # noqa: ARG001 - a factory's signature
    """Build the stage, and import the user's module. Raises BadInputError, TrilaneError."""
    return OwnCode(settings)


class Busy(PortedStage):
    """Uses `load_ms` milliseconds of CPU time for each frame. Nothing is written to the outputs, which stay zeros.

    If the file states a bypass, the frames that its `share` or `pattern` selects take it.
    """

    def __init__(self, settings: Mapping[str, Any]) -> None:
        super().__init__(settings)
        said = self.settings.keys.get("bypass")
        self._way = None if said is None else BypassKeys.model_validate(said)

    def work(self, frame: int, arrays: Sequence[NDArray[Any] | None], outputs: Arrays) -> Mapping[str, float]:  # noqa: ARG002
        # CPU time, because a stage without its core does no work.
        end_ns = time.thread_time_ns() + round(self.settings.keys["load_ms"] * NS_PER_MS)
        while time.thread_time_ns() < end_ns:
            pass
        return Skip() if self._way is not None and self._way.takes(frame) else {}


class Discard(PortedStage):
    """Takes frames and does nothing with them."""

    def work(self, frame: int, arrays: Sequence[NDArray[Any] | None], outputs: Arrays) -> Mapping[str, float]:  # noqa: ARG002
        return {}


def build_load(settings: Mapping[str, Any], unit: UnitContext) -> PortedStage:  # noqa: ARG001 - a factory's signature
    """Build the block that the key `block` names: `busy` or `discard`."""
    return {"busy": Busy, "discard": Discard}[settings["keys"]["block"]](settings)
