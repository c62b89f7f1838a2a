"""Facts about the machine that made a measurement. Every reported number has these facts beside it.

Rule: a fact was read or tried on this machine. A fact that could not be read is absent; none is guessed.
"""

from __future__ import annotations

import importlib.metadata
import json
import subprocess
import sys
from functools import cache
from typing import Any

from trilane import machine
from trilane.pipeline.job_times import availability

#: Instruction sets that decide how fast INT8 and FP32 networks run on a CPU.
CPU_FLAGS = (
    "avx2", "fma", "f16c", "avx512f", "avx512bw", "avx512_vnni", "avx_vnni", "avx512_bf16", "amx_tile", "amx_int8",
    "sha_ni",
)  # fmt: skip
ARM_FLAGS = ("asimd", "asimddp", "i8mm", "bf16", "sve", "sve2")

PACKAGES = (
    "numpy", "moderngl", "onnxruntime", "onnx", "pyzmq", "msgpack", "psutil", "rich", "typer", "pydantic", "av",
    "Pillow", "perfetto",
)  # fmt: skip
OPTIONAL_PACKAGES = {
    "openvino": "openvino",
    "onnxruntime-qnn": "qnn",
    "torch": "train",
    "anny": "anny",
    "mlcommons-loadgen": "loadgen",
}

GL_TIMEOUT_S = 30.0
GL_PROGRAM = "import json, trilane.stages.machine_facts as m; print(json.dumps(m.open_gl()))"
GL_LIMITS = (
    "GL_MAX_TEXTURE_SIZE", "GL_MAX_DRAW_BUFFERS", "GL_MAX_COLOR_ATTACHMENTS", "GL_MAX_UNIFORM_BLOCK_SIZE",
    "GL_MAX_TEXTURE_BUFFER_SIZE", "GL_MAX_VIEWPORT_DIMS",
)  # fmt: skip


def package_version(name: str) -> str | None:
    """Return the version of distribution `name`; None if it is not installed."""
    try:
        return importlib.metadata.version(name)
    except importlib.metadata.PackageNotFoundError:
        return None


def versions_with(package: str) -> list[str]:
    """Return name and version of each package on which measured times depend. `package`: package of the runtime."""
    return [f"{name} {package_version(name)}" for name in dict.fromkeys(("trilane", *PACKAGES, package))]


def cpu_facts() -> dict[str, Any]:
    """Return model, architecture, instruction sets and cores; `cores_allowed`: cores that this process may use."""
    flags = machine.here.cpu_flags()
    return {
        "model": machine.here.cpu_model(),
        "architecture": machine.here.architecture(),
        "flags": [flag for flag in CPU_FLAGS + ARM_FLAGS if flag in flags],
        "cores": machine.here.core_count(),
        "cores_allowed": list(machine.here.cores()),
    }


def open_gl() -> dict[str, Any]:
    """Open an OpenGL context in this process, and return facts about its driver and limits. Raises MissingPartError."""
    from trilane.stages.gpu.opengl import describe, open_context

    context = open_context()
    driver, info = describe(context), context.info
    limits = {name: info[name] for name in GL_LIMITS if name in info}
    return {
        "vendor": driver.vendor,
        "renderer": driver.renderer,
        "version": driver.version,
        "hardware": driver.hardware,
        "limits": limits,
    }


@cache
def gl_facts() -> dict[str, Any] | None:
    """Return the facts of `open_gl` about the driver that EGL gives; None if no driver works.

    A process of its own tries the driver, because a driver may crash.
    """
    command = [sys.executable, "-P", "-c", GL_PROGRAM]
    try:
        done = subprocess.run(command, capture_output=True, timeout=GL_TIMEOUT_S, check=True)
        facts = json.loads(done.stdout)
    except (OSError, subprocess.SubprocessError, ValueError):
        return None
    return facts if isinstance(facts, dict) else None


def runtime_facts() -> dict[str, Any]:
    """Return the providers of ONNX Runtime and, if it is installed, the devices of OpenVINO, by package."""
    import onnxruntime

    facts: dict[str, Any] = {"onnxruntime": list(onnxruntime.get_available_providers())}
    if package_version("openvino"):
        from trilane.stages.dsp.runtime import quiet_openvino

        facts["openvino"] = list(quiet_openvino().Core().available_devices)
    return facts


def machine_facts(gl: dict[str, Any] | None = None) -> dict[str, Any]:
    """Return all facts that stand beside a measurement. `gl`: result of `gl_facts`; None if it is missing."""
    packages = {name: package_version(name) for name in (*PACKAGES, *OPTIONAL_PACKAGES)}
    return {
        "system": machine.here.system(),
        "python": machine.here.python(),
        "trilane": package_version("trilane"),
        "cpu": cpu_facts(),
        "hardware_counters": availability(),
        "memory_bytes": machine.here.memory_bytes(),
        "gl": gl,
        "packages": {name: version for name, version in packages.items() if version is not None},
    }
