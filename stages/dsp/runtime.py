"""Runtimes, which run an integer network: the protocol that each of them offers, and the table of all of them.

Rule: a runtime is chosen by name; it runs the network or the run stops with an error. None falls back to another.
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

    `threads`: number of computing threads, the calling one included. `spin`: whether they may spin between jobs.
    `device`: settings that only one runtime has, by its own names, such as `htp_arch` of `qnn`.
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
        """Bind C-contiguous buffers, in the order of the network's inputs and outputs; they must outlive the binding.

        A whole network has one input (N, H, W, C) and one output (N, H, W, 4); a part has the tensors of its cuts.
        """


class Runtime(Protocol):
    """The interface that each runtime's module in this folder offers."""

    def load(self, network: IntegerNetwork, options: RuntimeOptions) -> Session:
        """Compile `network` for its shape. Raises BadInputError naming a node that it cannot run in integers."""

    def version(self) -> str:
        """Return the name and version of the installed library."""


@dataclass(frozen=True)
class RuntimeEntry:
    """A runtime: its module, the package it needs, the command that installs it, and a file the package must contain.

    `file`: path relative to the package's folder; empty when the package alone suffices.
    `copies`: whether each run copies the slots to a device's memory, and back.
    """

    module: str
    package: str
    install: Callable[[], str]
    file: str = ""
    copies: bool = False

    @property
    def is_installed(self) -> bool:
        """Return whether the package, and its `file`, are there."""
        begins = machine.here.package_file(self.package)
        return begins is not None and (not self.file or (begins.parent / self.file).is_file())


def cuda_line() -> str:
    """Return the command for the runtime `cuda`: the build for GPUs replaces the other, whose modules it contains."""
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
    """Return `name` itself. Raises BadInputError when it is no runtime, MissingPartError when it is not installed."""
    if name not in RUNTIMES:
        raise BadInputError("runtime", f"{name!r}", f"one of {', '.join(RUNTIMES)}", did_you_mean(name, RUNTIMES))
    entry = RUNTIMES[name]
    if not entry.is_installed:
        what = f"a build of {entry.package} with {entry.file}" if entry.file else f"the package {entry.package}"
        raise MissingPartError(f"runtime {name} needs {what}", entry.install())
    return name


def has_device(name: str) -> bool:
    """Return whether runtime `name` computes on hardware of its own; on x86, `qnn` emulates it on the cores."""
    return name == "cuda" or (name == "qnn" and machine.here.architecture() not in X86)


def copies_slots(name: str) -> bool:
    """Return whether runtime `name` copies slots to its device and back in every run; the others work in the slots."""
    return RUNTIMES[name].copies


def load_runtime(name: str) -> Runtime:
    """Return the module of runtime `name`. Raises as `resolve`."""
    module: Runtime = import_module(RUNTIMES[resolve(name)].module)
    return module


def quiet_openvino() -> Any:
    """Import OpenVINO without its telemetry; all code imports it by this function.

    Imported directly, it reports to its maker's server that it was imported, and keeps a number for that in the home
    folder. Without the package `openvino_telemetry` it uses a stand-in of its own, which does neither.
    """
    cast(dict[str, Any], sys.modules).setdefault("openvino_telemetry", None)
    import openvino

    return openvino


def said_by_openvino(error: RuntimeError) -> str:
    """Return the text of an error of OpenVINO as part of a sentence: on one line, without the stop at its end."""
    return " ".join(str(error).split()).rstrip(".")
