"""`trilane doctor`: what this machine has, and a machine that has nothing with the line that installs each part."""

from __future__ import annotations

import errno
import json
import os
from collections import namedtuple
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import asdict
from pathlib import Path
from typing import Any

import pytest

from trilane import machine
from trilane.apps.cli import doctor
from trilane.apps.cli.doctor import PartCheck
from trilane.pipeline import job_times
from trilane.stages import machine_facts

Command = Callable[..., tuple[str, str]]
GL = {"renderer": "a [driver]", "version": "4.5", "hardware": True}
CPU = {"model": "a processor", "flags": [], "cores": 8, "cores_allowed": [0, 2, 5]}


def test_what_runs_these_tests_is_there_and_what_was_tried_is_given_back() -> None:
    before = len(list(Path("/proc/self/fd").iterdir()))
    rows = {row.name: row for row in doctor.checks(GL)}
    assert all(rows[name].works for name in ("Python", "CPU", "memfd", "inference runtimes", "numpy", "onnxruntime"))
    assert rows["EGL and OpenGL"].found == "a [driver], 4.5 (hardware)"
    assert "onnxruntime: " in rows["inference runtimes"].found
    assert [row.name for row in doctor.checks({**GL, "hardware": False}) if "software" in row.found] == [
        "EGL and OpenGL"
    ]
    assert len(list(Path("/proc/self/fd").iterdir())) == before


def test_memory_that_gets_no_size_is_given_back(monkeypatch: pytest.MonkeyPatch) -> None:
    def refused(*_: int) -> None:
        raise OSError(errno.EPERM, "Operation not permitted")

    before = len(list(Path("/proc/self/fd").iterdir()))
    monkeypatch.setattr(os, "ftruncate", refused)
    assert doctor._memfd().found == "operation not permitted"
    assert len(list(Path("/proc/self/fd").iterdir())) == before


@pytest.mark.parametrize("flag", ["avx512_vnni", "avx_vnni", "amx_int8", "asimddp", "i8mm"])
def test_any_instruction_for_dot_products_is_enough(flag: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(machine_facts, "cpu_facts", lambda: {**CPU, "flags": ["avx2", flag]})
    (row,) = [row for row in doctor.checks(GL) if row.name == "INT8 dot product"]
    assert (row.found, row.works) == (flag, True)


def test_a_machine_that_has_nothing(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    @contextmanager
    def asleep() -> Iterator[str]:
        yield "may sleep"

    def refused(*_: object) -> int:
        raise PermissionError(1, "Operation not permitted")

    def broken() -> dict[str, Any]:
        raise ImportError("no libonnxruntime.so")

    for place, name, value in (
        (doctor.sys, "version_info", namedtuple("Version", "major minor")(3, 10)),
        (machine_facts, "PACKAGES", ("numpy",)),
        (machine_facts, "OPTIONAL_PACKAGES", {"torch": "train"}),
        (machine_facts, "package_version", lambda _: None),
        (machine_facts, "cpu_facts", lambda: CPU),
        (machine_facts, "runtime_facts", broken),
        (machine, "awake", asleep),
        (job_times, "absence", lambda: "kernel.perf_event_paranoid is 3"),
        (doctor, "SHM", tmp_path / "none"),
        (os, "memfd_create", refused),
        (doctor, "package_line", lambda name: f"pip install {name}"),
        (doctor, "install_line", lambda extra: f"pip install trilane[{extra}]"),
    ):
        monkeypatch.setattr(place, name, value)
    found = [(row.name, row.found, row.works, row.needed, row.install) for row in doctor.checks(None)]
    acl = f'apt-get install acl; setfacl -m "u:$USER:w" {machine.LATENCY_FILE}'
    no_int8, memfd = (
        "no; INT8 networks run on AVX2 or NEON alone",
        "needs Linux 3.17 or newer with memfd_create allowed",
    )
    needed = ["Python", "CPU", "memfd", "EGL and OpenGL", "inference runtimes", "numpy"]
    assert [row[0] for row in found if row[3]] == needed
    assert [row[0] for row in found if row[2]] == ["CPU"]
    assert [(name, said, install) for name, said, _, _, install in found[1:]] == [
        ("CPU", "a processor, 3 of 8 cores allowed, none of those that matter", ""),
        ("INT8 dot product", no_int8, "needs another CPU"),
        ("hardware counters", "kernel.perf_event_paranoid is 3", "sysctl kernel.perf_event_paranoid=2"),
        ("memfd", "operation not permitted", memfd),
        (str(tmp_path / "none"), "absent", "mount -t tmpfs tmpfs /dev/shm"),
        ("idle cores", "may sleep", acl),
        ("EGL and OpenGL", "no OpenGL 3.3 context can be made", "apt-get install libegl1 libgl1-mesa-dri"),
        ("inference runtimes", "ImportError: no libonnxruntime.so", "pip install onnxruntime"),
        ("numpy", "missing", "pip install numpy"),
        ("torch", "missing", "pip install trilane[train]"),
    ]


ROWS = [
    PartCheck("first", "1.2 [x]", True, True, "never shown"),
    PartCheck("second", "missing", False, True, "pip install x[y]"),
    PartCheck("third", "absent", False, False, "mount it"),
]


@pytest.mark.parametrize(("rows", "code"), [(ROWS, 3), ([ROWS[0], ROWS[2]], 0)])
def test_a_needed_part_that_is_missing_ends_with_3(
    rows: list[PartCheck], code: int, monkeypatch: pytest.MonkeyPatch, command: Command
) -> None:
    monkeypatch.setattr(machine_facts, "gl_facts", lambda: GL)
    monkeypatch.setattr(doctor, "checks", lambda _: rows)
    document = json.loads(command("doctor", "--json", code=code)[0])
    assert (document["complete"], document["checks"]) == (code == 0, [asdict(row) for row in rows])
    lines = command("doctor", code=code)[0].splitlines()
    shown = [[cell.strip() for cell in line.split("│")[1:-1]] for line in lines if "│" in line]
    words = {ROWS[0].name: "works", ROWS[1].name: "missing", ROWS[2].name: "absent"}
    assert shown == [[row.name, words[row.name], row.found, "" if row.works else row.install] for row in rows]
