"""What runs an integer network: the protocol every runtime keeps, and the table of those there are.

Rule: a runtime is chosen by name and is what runs, or the run stops and says so; none falls back to another.
"""

from __future__ import annotations

import importlib.util
import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import Protocol

from trilane.arrays import U8
from trilane.avatars.network_file import IntegerNetwork
from trilane.errors import BadInputError, MissingPartError
from trilane.install import install_line, package_line, pip


@dataclass(frozen=True)
class RuntimeOptions:
    """`threads`: that compute, this process's own included. `spin`: may they spin between jobs.

    `device`: settings of a runtime's own, by its own names, such as `htp_arch` of `qnn`.
    """

    threads: int = 1
    spin: bool = False
    device: Mapping[str, str] = field(default_factory=dict)


class Binding(Protocol):
    """A network bound to its buffers."""

    def run(self) -> None:
        """Compute the output buffers from the input buffers; nothing is copied or allocated."""


class Session(Protocol):
    """A loaded network of one shape."""

    def bind(self, inputs: Sequence[U8], outputs: Sequence[U8]) -> Binding:
        """Bind buffers, C-contiguous, in the network's order; all must outlive the binding.

        A whole network has one input (N, H, W, C) and one output (N, H, W, 4); a part has those of its cuts.
        """


class Runtime(Protocol):
    """A module of this folder."""

    def load(self, network: IntegerNetwork, options: RuntimeOptions) -> Session:
        """Compile for the network's own shape. Raises BadInputError naming a node that it cannot run in integers."""

    def version(self) -> str:
        """Of the library, as it is installed."""


@dataclass(frozen=True)
class RuntimeEntry:
    """Where a runtime lives, the package that it needs, a file that this package must hold, and how to get that."""

    module: str
    package: str
    install: Callable[[], str]
    file: str = ""

    @property
    def is_installed(self) -> bool:
        spec = importlib.util.find_spec(self.package)
        return spec is not None and (not self.file or (Path(spec.origin or "").parent / self.file).is_file())


def cuda_line() -> str:
    """The command for the runtime `cuda`: the build for GPUs replaces the other, whose modules it has."""
    here = pip()
    return f"{here} uninstall -y onnxruntime && {here} install onnxruntime-gpu  # on a machine with an NVIDIA GPU"


RUNTIMES = {
    "openvino": RuntimeEntry("trilane.stages.dsp.openvino", "openvino", partial(install_line, "openvino")),
    "ort": RuntimeEntry("trilane.stages.dsp.ort", "onnxruntime", partial(package_line, "onnxruntime")),
    "qnn": RuntimeEntry("trilane.stages.dsp.qnn", "onnxruntime_qnn", partial(install_line, "qnn")),
    "cuda": RuntimeEntry(
        "trilane.stages.dsp.cuda",
        "onnxruntime",
        cuda_line,
        "capi/libonnxruntime_providers_cuda.so",
    ),
}


def installed() -> Sequence[str]:
    """Names of the runtimes whose package is present."""
    return [name for name, entry in RUNTIMES.items() if entry.is_installed]


def resolve(name: str) -> str:
    """`name`, which is an installed runtime. Raises BadInputError, MissingPartError."""
    if name not in RUNTIMES:
        raise BadInputError("runtime", f"{name!r}", f"one of {', '.join(RUNTIMES)}")
    entry = RUNTIMES[name]
    if not entry.is_installed:
        what = f"a build of {entry.package} with {entry.file}" if entry.file else f"the package {entry.package}"
        raise MissingPartError(f"runtime {name} needs {what}", entry.install())
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
