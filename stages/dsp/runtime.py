"""What runs an integer network: the protocol every runtime keeps, and the table of those there are.

Rule: a runtime is chosen by name and is what runs, or the run stops and says so; none falls back to another.
"""

from __future__ import annotations

import importlib.util
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from importlib import import_module
from pathlib import Path
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from trilane.avatars.network_file import NetworkFile
from trilane.errors import BadInputError, MissingPartError

AUTO = "auto"


@dataclass(frozen=True)
class RuntimeOptions:
    """`threads`: that compute, this process's own included. `spin`: may they spin between jobs.

    `device`: settings of a runtime's own, by its own names, such as `htp_arch` of `qnn`.
    """

    threads: int = 1
    spin: bool = False
    device: Mapping[str, str] = field(default_factory=dict)


class Binding(Protocol):
    """A network bound to one input and one output buffer."""

    def run(self) -> None:
        """Compute the output buffer from the input buffer; nothing is copied or allocated."""


class Session(Protocol):
    """A loaded network of one shape."""

    def bind(self, tensor: NDArray[np.uint8], image: NDArray[np.uint8]) -> Binding:
        """Bind buffers: `tensor` (N, H, W, C), `image` (N, H, W, 4), C-contiguous; both must outlive the binding."""


class Runtime(Protocol):
    """A module of this folder."""

    def load(self, network: NetworkFile, options: RuntimeOptions) -> Session:
        """Compile for the network's own shape. Raises BadInputError naming a node that it cannot run in integers."""

    def version(self) -> str:
        """Of the library, as it is installed."""


@dataclass(frozen=True)
class RuntimeEntry:
    """Where a runtime lives, what it needs, and how to get that."""

    module: str
    package: str
    install: str


#: Fastest first, by measurement: `auto` takes the first that is installed. An emulator is never the fastest.
RUNTIMES = {
    "openvino": RuntimeEntry("trilane.stages.dsp.openvino", "openvino", "pip install 'trilane[openvino]'"),
    "ort": RuntimeEntry("trilane.stages.dsp.ort", "onnxruntime", "pip install onnxruntime"),
    "qnn": RuntimeEntry("trilane.stages.dsp.qnn", "onnxruntime_qnn", "pip install 'trilane[qnn]'"),
}


def installed() -> Sequence[str]:
    """Names of the runtimes whose package is present, fastest first."""
    return [name for name, entry in RUNTIMES.items() if importlib.util.find_spec(entry.package)]


def resolve(name: str) -> str:
    """The runtime that `name` means: `auto` is the fastest installed one. Raises BadInputError, MissingPartError."""
    if name == AUTO:
        return installed()[0]
    if name not in RUNTIMES:
        raise BadInputError("runtime", f"{name!r}", f"{AUTO} or one of {', '.join(RUNTIMES)}")
    entry = RUNTIMES[name]
    if importlib.util.find_spec(entry.package) is None:
        raise MissingPartError(f"runtime {name} needs the package {entry.package}", entry.install)
    return name


def load_runtime(name: str) -> Runtime:
    """The module of runtime `name`. Raises BadInputError, MissingPartError."""
    module: Runtime = import_module(RUNTIMES[resolve(name)].module)
    return module


def cache_dir(name: str) -> Path | None:
    """Where compiled networks of runtime `name` are kept: under XDG_CACHE_HOME. None when it cannot be written."""
    home = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    folder = Path(home) / "trilane" / name
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError:
        return None
    return folder if os.access(folder, os.W_OK) else None
