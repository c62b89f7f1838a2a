"""`trilane doctor`: the parts that this machine has, the missing parts, and the commands that install them.

Rule: shared memory, OpenGL and runtimes are tried here. A Python package counts as working if it is installed.
"""

from __future__ import annotations

import os
import shutil
import sys
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer

from trilane import machine
from trilane.apps.cli.commands import Commands, JsonOption
from trilane.apps.cli.console import print_json, stdout_console
from trilane.errors import EGL_LINE, install_line, package_line, reason

if TYPE_CHECKING:
    from rich.text import Text

app = Commands()

MISSING = 3
SHM = Path("/dev/shm")  # noqa: S108 - looked at, never written
EPILOG = "\b\nExamples:\n  trilane doctor\n  trilane doctor --json"


@dataclass(frozen=True)
class PartCheck:
    """The check of one part that a run uses.

    `name`: name of the part. `found`: finding in words. `works`: whether the part works; a package works if installed.
    `needed`: whether every run needs the part. `install`: command or advice that makes the part work; may be empty.
    """

    name: str
    found: str
    works: bool
    needed: bool = True
    install: str = ""


def _python() -> PartCheck:
    works = sys.version_info >= (3, 11)
    return PartCheck("Python", machine.here.python(), works, install="apt-get install python3.11 python3.11-venv")


def _packages() -> list[PartCheck]:
    from trilane.stages.machine_facts import OPTIONAL_PACKAGES, PACKAGES, package_version

    checks = []
    for name in PACKAGES:
        version = package_version(name)
        checks.append(PartCheck(name, version or "missing", version is not None, install=package_line(name)))
    for name, extra in OPTIONAL_PACKAGES.items():
        version = package_version(name)
        line = install_line(extra)
        checks.append(PartCheck(name, version or "missing", version is not None, needed=False, install=line))
    return checks


def _gl(facts: dict[str, Any] | None) -> PartCheck:
    if facts is None:
        return PartCheck("EGL and OpenGL", "no OpenGL 3.3 context can be made", works=False, install=EGL_LINE)
    kind = "hardware" if facts["hardware"] else "software, on the CPU"
    return PartCheck("EGL and OpenGL", f"{facts['renderer']}, {facts['version']} ({kind})", works=True)


def _runtimes() -> PartCheck:
    from trilane.stages.machine_facts import runtime_facts

    try:
        facts = runtime_facts()
    except Exception as error:  # a broken package may raise anything
        found = f"{type(error).__name__}: {error}"
        return PartCheck("inference runtimes", found, works=False, install=package_line("onnxruntime"))
    found = "; ".join(f"{runtime}: {', '.join(places)}" for runtime, places in facts.items())
    return PartCheck("inference runtimes", found, works=bool(facts["onnxruntime"]))


def _cpu() -> PartCheck:
    from trilane.stages.machine_facts import cpu_facts

    cpu = cpu_facts()
    flags = " ".join(cpu["flags"]) or "none of those that matter"
    found = f"{cpu['model']}, {len(cpu['cores_allowed'])} of {cpu['cores']} cores allowed, {flags}"
    return PartCheck("CPU", found, works=True)


def _int8() -> PartCheck:
    from trilane.stages.machine_facts import cpu_facts

    present = {"avx512_vnni", "avx_vnni", "amx_int8", "asimddp", "i8mm"} & set(cpu_facts()["flags"])
    found = " ".join(sorted(present)) or "no; INT8 networks run on AVX2 or NEON alone"
    return PartCheck("INT8 dot product", found, works=bool(present), needed=False, install="needs another CPU")


def _memfd() -> PartCheck:
    try:
        handle = os.memfd_create("trilane-doctor", os.MFD_CLOEXEC)
        try:
            os.ftruncate(handle, 4096)
        finally:
            os.close(handle)
    except (AttributeError, OSError) as error:
        return PartCheck(
            "memfd", reason(error), works=False, install="needs Linux 3.17 or newer with memfd_create allowed"
        )
    return PartCheck("memfd", "anonymous shared memory works", works=True)


def _dev_shm() -> PartCheck:
    """Check whether /dev/shm exists. A run does not need it, because slots are memfds."""
    if not SHM.is_dir():
        return PartCheck(str(SHM), "absent", works=False, needed=False, install="mount -t tmpfs tmpfs /dev/shm")
    free = shutil.disk_usage(SHM).free
    return PartCheck(str(SHM), f"{free / 2**20:.0f} MiB free; Trilane leaves nothing there", works=True, needed=False)


def _wakeup() -> PartCheck:
    """Check whether a run can keep idle cores awake. Otherwise, a message to a sleeping core takes 50 us more."""
    from trilane.machine import AWAKE, LATENCY_FILE, awake

    install = f'apt-get install acl; setfacl -m "u:$USER:w" {LATENCY_FILE}'
    with awake() as idle_cores:
        return PartCheck("idle cores", idle_cores, works=idle_cores == AWAKE, needed=False, install=install)


def _counters() -> PartCheck:
    """Check the CPU's hardware counters. Without these counters, a trace has no instructions and no cache misses."""
    from trilane.pipeline.job_times import absence, availability, remedy

    why = absence()
    install = "" if why is None else remedy(why)
    return PartCheck("hardware counters", why or availability(), works=why is None, needed=False, install=install)


def checks(gl: dict[str, Any] | None) -> list[PartCheck]:
    """Return the checks of all parts, in the order of the output.

    `gl`: result of `gl_facts`; None if no OpenGL driver works.
    """
    machine = [_python(), _cpu(), _int8(), _counters(), _memfd(), _dev_shm(), _wakeup(), _gl(gl)]
    return [*machine, _runtimes(), *_packages()]


def _state(check: PartCheck) -> Text:
    from rich.text import Text

    if check.works:
        return Text("works", "green")
    return Text("missing", "red") if check.needed else Text("absent", "yellow")


def _print_table(rows: list[PartCheck]) -> None:
    from rich.table import Table

    table = Table(title="What this machine has", title_justify="left")
    for column in ("part", "state", "found", "fix"):
        table.add_column(column, overflow="fold")
    for row in rows:
        table.add_row(row.name, _state(row), row.found, "" if row.works else row.install)
    stdout_console().print(table)


@app.command(epilog=EPILOG)
def doctor(as_json: JsonOption = False) -> None:
    """Say what this machine has, what is missing and how to install it. Exit code 3 when a needed part is missing."""
    from trilane.stages.machine_facts import gl_facts, machine_facts

    gl = gl_facts()
    rows = checks(gl)
    complete = all(row.works for row in rows if row.needed)
    if as_json:
        print_json({"complete": complete, "checks": [asdict(row) for row in rows], "machine": machine_facts(gl)})
    else:
        _print_table(rows)
    if not complete:
        raise typer.Exit(MISSING)
