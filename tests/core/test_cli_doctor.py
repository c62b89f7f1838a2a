"""`trilane doctor` on machines that a test makes up: what each part is said to have, and the line that mends it."""

from __future__ import annotations

import json
import os
import shutil
from collections import namedtuple
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from trilane import machine
from trilane.apps.cli import doctor
from trilane.apps.cli.doctor import PartCheck
from trilane.pipeline import hardware_counters
from trilane.stages import machine_facts
from trilane.transport import wakeup

Command = Callable[..., tuple[str, str]]
CPU = {"model": "a processor", "flags": ["avx2", "avx512_vnni", "amx_int8"], "cores": 8, "cores_allowed": [0, 2, 5]}
GL = {"renderer": "a [driver]", "version": "4.5", "hardware": True}
Version = namedtuple("Version", "major minor")


@pytest.fixture
def well_equipped(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> pytest.MonkeyPatch:
    """A machine that has everything."""

    @contextmanager
    def awake() -> Iterator[str]:
        yield wakeup.AWAKE

    monkeypatch.setattr(doctor.sys, "version_info", Version(3, 11))
    monkeypatch.setattr(machine.here, "python", lambda: "3.11.9")
    monkeypatch.setattr(machine_facts, "PACKAGES", ("numpy", "av"))
    monkeypatch.setattr(machine_facts, "OPTIONAL_PACKAGES", {"openvino": "openvino", "torch": "train"})
    monkeypatch.setattr(machine_facts, "package_version", lambda name: f"{name}-1.2")
    monkeypatch.setattr(machine_facts, "cpu_facts", lambda: CPU)
    monkeypatch.setattr(machine_facts, "runtime_facts", lambda: {"onnxruntime": ["CPU", "QNN"], "openvino": ["GPU"]})
    monkeypatch.setattr(machine_facts, "gl_facts", lambda: GL)
    monkeypatch.setattr(machine_facts, "machine_facts", lambda gl: {"gl": gl})
    monkeypatch.setattr(wakeup, "awake", awake)
    monkeypatch.setattr(hardware_counters, "absence", lambda: None)
    monkeypatch.setattr(hardware_counters, "availability", lambda: "instructions, cache_misses")
    monkeypatch.setattr(doctor, "SHM", tmp_path)
    monkeypatch.setattr(doctor, "package_line", lambda name: f"pip install {name}")
    monkeypatch.setattr(doctor, "install_line", lambda extra: f"pip install trilane[{extra}]")
    monkeypatch.setattr(shutil, "disk_usage", lambda place: SimpleNamespace(free=3 * 2**20 + (place != tmp_path)))
    return monkeypatch


PYTHON = "apt-get install python3.11 python3.11-venv"
ACL = f'apt-get install acl; setfacl -m "u:$USER:w" {wakeup.LATENCY_FILE}'
PARANOID = "sysctl kernel.perf_event_paranoid=2"
MEMFD = "needs Linux 3.17 or newer with memfd_create allowed"


@pytest.mark.usefixtures("well_equipped")
def test_a_machine_that_has_everything(tmp_path: Path) -> None:
    assert doctor.checks(GL) == [
        PartCheck("Python", "3.11.9", True, True, PYTHON),
        PartCheck("CPU", "a processor, 3 of 8 cores allowed, avx2 avx512_vnni amx_int8", True, True, ""),
        PartCheck("INT8 dot product", "amx_int8 avx512_vnni", True, False, "needs another CPU"),
        PartCheck("hardware counters", "instructions, cache_misses", True, False, ""),
        PartCheck("memfd", "anonymous shared memory works", True, True, ""),
        PartCheck(str(tmp_path), "3 MiB free; Trilane leaves nothing there", True, False, ""),
        PartCheck("idle cores", wakeup.AWAKE, True, False, ACL),
        PartCheck("EGL and OpenGL", "a [driver], 4.5 (hardware)", True, True, ""),
        PartCheck("inference runtimes", "onnxruntime: CPU, QNN; openvino: GPU", True, True, ""),
        PartCheck("numpy", "numpy-1.2", True, True, "pip install numpy"),
        PartCheck("av", "av-1.2", True, True, "pip install av"),
        PartCheck("openvino", "openvino-1.2", True, False, "pip install trilane[openvino]"),
        PartCheck("torch", "torch-1.2", True, False, "pip install trilane[train]"),
    ]


def test_a_machine_that_has_nothing(well_equipped: pytest.MonkeyPatch, tmp_path: Path) -> None:
    @contextmanager
    def asleep() -> Iterator[str]:
        yield "may sleep"

    def refused(*_: object) -> int:
        raise PermissionError(1, "Operation not permitted")

    def broken() -> dict[str, Any]:
        raise ImportError("no libonnxruntime.so")

    well_equipped.setattr(doctor.sys, "version_info", Version(3, 10))
    well_equipped.setattr(machine_facts, "package_version", lambda _: None)
    well_equipped.setattr(machine_facts, "cpu_facts", lambda: {**CPU, "flags": []})
    well_equipped.setattr(machine_facts, "runtime_facts", broken)
    well_equipped.setattr(wakeup, "awake", asleep)
    well_equipped.setattr(hardware_counters, "absence", lambda: "kernel.perf_event_paranoid is 3")
    well_equipped.setattr(doctor, "SHM", tmp_path / "none")
    well_equipped.setattr(os, "memfd_create", refused)
    no_mesa = "apt-get install libegl1 libgl1-mesa-dri"
    assert doctor.checks(None) == [
        PartCheck("Python", "3.11.9", False, True, PYTHON),
        PartCheck("CPU", "a processor, 3 of 8 cores allowed, none of those that matter", True, True, ""),
        PartCheck("INT8 dot product", "no; INT8 networks run on AVX2 or NEON alone", False, False, "needs another CPU"),
        PartCheck("hardware counters", "kernel.perf_event_paranoid is 3", False, False, PARANOID),
        PartCheck("memfd", "operation not permitted", False, True, MEMFD),
        PartCheck(str(tmp_path / "none"), "absent", False, False, "mount -t tmpfs tmpfs /dev/shm"),
        PartCheck("idle cores", "may sleep", False, False, ACL),
        PartCheck("EGL and OpenGL", "no OpenGL 3.3 context can be made", False, True, no_mesa),
        PartCheck("inference runtimes", "ImportError: no libonnxruntime.so", False, True, "pip install onnxruntime"),
        PartCheck("numpy", "missing", False, True, "pip install numpy"),
        PartCheck("av", "missing", False, True, "pip install av"),
        PartCheck("openvino", "missing", False, False, "pip install trilane[openvino]"),
        PartCheck("torch", "missing", False, False, "pip install trilane[train]"),
    ]


@pytest.mark.parametrize("flag", ["avx512_vnni", "avx_vnni", "amx_int8", "asimddp", "i8mm"])
def test_any_instruction_for_dot_products_is_enough(flag: str, well_equipped: pytest.MonkeyPatch) -> None:
    well_equipped.setattr(machine_facts, "cpu_facts", lambda: {**CPU, "flags": ["avx2", flag]})
    assert doctor._int8() == PartCheck("INT8 dot product", flag, True, False, "needs another CPU")


def test_a_runtime_without_a_place_to_run_does_not_work(well_equipped: pytest.MonkeyPatch) -> None:
    well_equipped.setattr(machine_facts, "runtime_facts", lambda: {"onnxruntime": []})
    assert not doctor._runtimes().works


@pytest.mark.usefixtures("well_equipped")
def test_a_driver_on_the_cpu_is_named() -> None:
    assert doctor._gl({**GL, "hardware": False}).found == "a [driver], 4.5 (software, on the CPU)"


def test_memory_is_tried_and_given_back() -> None:
    before = len(list(Path("/proc/self/fd").iterdir()))
    assert doctor._memfd() == PartCheck("memfd", "anonymous shared memory works", True)
    assert len(list(Path("/proc/self/fd").iterdir())) == before


def test_memory_that_cannot_grow_does_not_work(monkeypatch: pytest.MonkeyPatch) -> None:
    asked = []

    def full(_descriptor: int, size: int) -> None:
        asked.append(size)
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "ftruncate", full)
    assert (doctor._memfd().found, doctor._memfd().works, asked[0]) == ("no space left on device", False, 4096)


ROWS = [
    PartCheck("first", "1.2 [x]", True, True, "never shown"),
    PartCheck("second", "missing", False, True, "pip install x[y]"),
    PartCheck("third", "absent", False, False, "mount it"),
]


@pytest.mark.parametrize(("rows", "code"), [(ROWS, 3), ([ROWS[0], ROWS[2]], 0)])
def test_the_table_and_the_exit_code(
    rows: list[PartCheck],
    code: int,
    well_equipped: pytest.MonkeyPatch,
    command: Command,
    check_printed: Callable[..., None],
) -> None:
    well_equipped.setattr(doctor, "checks", lambda gl: rows if gl is GL else [])
    out, err = command("doctor", code=code)
    assert err == ""
    check_printed(f"doctor-{code}", out)
    document = json.loads(command("doctor", "--json", code=code)[0])
    keys = ("name", "found", "works", "needed", "install")
    assert document == {
        "complete": code == 0,
        "checks": [{key: getattr(row, key) for key in keys} for row in rows],
        "machine": {"gl": GL},
    }
