"""Runtimes, which run an integer network: the protocol of a runtime, and the table of all runtimes.

Rule: a runtime is chosen by name. It runs the network, or the run stops with an error; none falls back to another.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from importlib import import_module
from typing import Any, Protocol, cast

from trilane import machine
from trilane.arrays import U8
from trilane.avatars.network_file import IntegerNetwork
from trilane.errors import BadInputError, MissingPartError, did_you_mean, install_line, package_line, pip

X86 = ("x86_64", "AMD64")


@dataclass(frozen=True)
class RuntimeOptions:
    """Options of a runtime.

    `threads`: number of computing threads, including the calling thread.
    `spin`: whether the threads may spin between jobs.
    `device`: settings of one runtime, by its own names, such as `htp_arch` of `qnn`.
    """

    threads: int = 1
    spin: bool = False
    device: Mapping[str, str] = field(default_factory=dict)


class Binding(Protocol):
    """A network bound to its buffers."""

    def run(self) -> None:
        """Compute the output buffers from the input buffers; nothing is copied or allocated."""


class Session(Protocol):
    """A loaded network, or a loaded part of one, for one tensor shape."""

    def bind(self, inputs: Sequence[U8], outputs: Sequence[U8]) -> Binding:
        """Return a binding to arrays in the order of the network's inputs and outputs.

        The arrays must be C-contiguous, and outlive the binding. A whole network has one input (N,H,W,C) and one output
        (N,H,W,4); a part has the tensors of its cuts.
        """


class Runtime(Protocol):
    """The interface that each runtime's module in this folder offers."""

    def load(self, network: IntegerNetwork, options: RuntimeOptions) -> Session:
        """Return `network` compiled for its shape. Raises BadInputError naming a node that cannot run in integers."""

    def version(self) -> str:
        """Return the name and version of the installed library."""


@dataclass(frozen=True)
class RuntimeEntry:
    """A row of the table of runtimes.

    `module`: module that implements `Runtime`.
    `package`: package that the runtime needs.
    `install`: function that returns the command that installs the package.
    `file`: file that the package must contain, relative to its folder; empty for none.
    `copies`: whether each run copies the slots to a device's memory, and back.
    """

    module: str
    package: str
    install: Callable[[], str]
    file: str = ""
    copies: bool = False

    @property
    def is_installed(self) -> bool:
        """Whether the package is installed and has its `file`."""
        begins = machine.here.package_file(self.package)
        return begins is not None and (not self.file or (begins.parent / self.file).is_file())


def cuda_line() -> str:
    """Return the command that installs the runtime `cuda`.

    The command first removes the package for the CPU, because both packages have the same files.
    """
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
        copies=True,
    ),
}


def installed() -> Sequence[str]:
    """Return the names of the installed runtimes."""
    return [name for name, entry in RUNTIMES.items() if entry.is_installed]


def resolve(name: str) -> str:
    """Return `name`. Raises BadInputError if it names no runtime, MissingPartError for a runtime not installed."""
    if name not in RUNTIMES:
        raise BadInputError("runtime", f"{name!r}", f"one of {', '.join(RUNTIMES)}", did_you_mean(name, RUNTIMES))
    entry = RUNTIMES[name]
    if not entry.is_installed:
        what = f"a build of {entry.package} with {entry.file}" if entry.file else f"the package {entry.package}"
        raise MissingPartError(f"runtime {name} needs {what}", entry.install())
    return name


def has_device(name: str) -> bool:
    """Return whether runtime `name` computes on a device; on x86, `qnn` only emulates its device on the cores."""
    return name == "cuda" or (name == "qnn" and machine.here.architecture() not in X86)


def copies_slots(name: str) -> bool:
    """Return whether each run of runtime `name` copies the slots to its device's memory and back."""
    return RUNTIMES[name].copies


def load_runtime(name: str) -> Runtime:
    """Return the module of runtime `name`. Raises as `resolve` does."""
    module: Runtime = import_module(RUNTIMES[resolve(name)].module)
    return module


def quiet_openvino() -> Any:
    """Return the module `openvino`, imported without its telemetry; all code imports OpenVINO by this function.

    With telemetry, an import reports to the maker's server, and stores an id in the home folder. Without the package
    `openvino_telemetry`, OpenVINO uses its own stand-in, which does neither.
    """
    cast(dict[str, Any], sys.modules).setdefault("openvino_telemetry", None)
    import openvino

    return openvino


def said_by_openvino(error: RuntimeError) -> str:
    """Return the text of an error of OpenVINO as part of a sentence: on one line, without the full stop."""
    return " ".join(str(error).split()).rstrip(".")
