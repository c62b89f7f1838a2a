"""Whether memory is what a failure lacks: limits, the kernel's count, and what is said of them."""

from __future__ import annotations

import errno
import re
import resource
import subprocess
import sys
from dataclasses import dataclass, field
from pathlib import Path
from types import SimpleNamespace

import pytest

from trilane import machine
from trilane.apps.cli.main import describe
from trilane.errors import BadInputError, MissingPartError, TrilaneError
from trilane.machine import Machine
from trilane.pipeline import unit_loop
from trilane.pipeline.unit_processes import listen_before_run
from trilane.stages.configure import required_machine
from trilane.transport.messages import BUILDING, Failed

MIB = 1 << 20
LIMITS = Path(__file__).parents[2] / "docs" / "limits.md"
GIGABYTE = str(1 << 30)


@pytest.fixture
def plenty(monkeypatch: pytest.MonkeyPatch) -> pytest.MonkeyPatch:
    """No limit, and no process ended for lack of memory."""
    monkeypatch.setattr(resource, "getrlimit", lambda _kind: (resource.RLIM_INFINITY, resource.RLIM_INFINITY))
    monkeypatch.setattr(machine.here, "memory_limit_bytes", lambda: None)
    monkeypatch.setattr(machine.here, "oom_kills", lambda: machine._KILLS)
    monkeypatch.setattr(machine.here, "free_bytes", lambda: 77 * MIB)
    return monkeypatch


def test_plenty_of_memory_is_never_short(plenty: pytest.MonkeyPatch) -> None:
    machine.require_memory()
    assert machine.shortage() == ""
    plenty.setattr(machine.here, "memory_limit_bytes", lambda: machine.RUN_BYTES)
    assert machine.shortage() == ""


def test_each_shortage_says_what_is_there_and_what_is_needed(plenty: pytest.MonkeyPatch) -> None:
    plenty.setattr(machine.here, "oom_kills", lambda: machine._KILLS + 1)
    ended = "the system has meanwhile ended a process because memory ran out, and a run takes 600 MiB"
    assert machine.shortage() == machine.ended_by_system() == f"{ended}; 77 MiB are free now"
    plenty.setattr(machine.here, "memory_limit_bytes", lambda: 200 * MIB)
    assert machine.shortage() == "the control group may have 200 MiB of memory, and a run takes 600 MiB"
    plenty.setattr(resource, "getrlimit", lambda _kind: (900 * MIB, 900 * MIB))
    said = "each process may have 900 MiB of addresses (ulimit -v), and a run's largest process takes 1700 MiB"
    assert machine.shortage() == f"{said}: ulimit -v unlimited"


def limit_addresses(plenty: pytest.MonkeyPatch, bytes_: int) -> None:
    """Set the limit that a process reaches (`ulimit -S -v`); no other limit, nor the one that may be asked for, is."""
    free = resource.RLIM_INFINITY
    plenty.setattr(resource, "getrlimit", lambda kind: (bytes_ if kind == resource.RLIMIT_AS else free, free))


def test_addresses_are_short_below_what_the_largest_process_takes(plenty: pytest.MonkeyPatch) -> None:
    """docs/limits.md has the figure, and the measured one that it is rounded up from, by less than a twentieth."""
    row = next(line for line in LIMITS.read_text().splitlines() if line.startswith("| `machine.ADDRESS_BYTES`"))
    needed, measured_mb = int(row.split("|")[2]), int(re.findall(r"measured, .*?: (\d+) MiB", row)[0])
    assert measured_mb * MIB <= needed < 1.05 * measured_mb * MIB
    limit_addresses(plenty, needed)
    assert machine.shortage() == ""
    limit_addresses(plenty, needed - 1)
    said = f"(ulimit -v), and a run's largest process takes {needed // MIB} MiB: ulimit -v unlimited"
    assert machine.shortage() == f"each process may have {(needed - 1) // MIB} MiB of addresses {said}"


@pytest.mark.parametrize("part", [1, 2])
def test_a_limit_of_addresses_that_no_run_fits_in_is_refused(plenty: pytest.MonkeyPatch, part: int) -> None:
    least = machine.LEAST_ADDRESS_BYTES // part
    limit_addresses(plenty, least)
    machine.require_memory(part)
    limit_addresses(plenty, least - 1)
    with pytest.raises(TrilaneError) as raised:
        machine.require_memory(part)
    found = f"memory: found a limit of {(least - 1) // MIB} MiB of addresses (ulimit -v)"
    assert str(raised.value) == f"{found}, expected at least 1700 MiB for a run: ulimit -v unlimited"


@pytest.mark.parametrize("part", [1, 2])
def test_a_control_group_that_no_run_fits_in_is_refused(plenty: pytest.MonkeyPatch, part: int) -> None:
    """The kernel would end a process of it, which says nothing."""
    least = machine.LEAST_RUN_BYTES // part
    plenty.setattr(machine.here, "memory_limit_bytes", lambda: least)
    machine.require_memory(part)
    plenty.setattr(machine.here, "memory_limit_bytes", lambda: least - 1)
    with pytest.raises(TrilaneError) as raised:
        machine.require_memory(part)
    found = f"memory: found a limit of {(least - 1) // MIB} MiB for the control group"
    assert str(raised.value) == f"{found}, expected at least 600 MiB for a run"


def test_no_opengl_context_is_no_missing_package_where_memory_is_short(plenty: pytest.MonkeyPatch) -> None:
    with pytest.raises(MissingPartError, match=r"no OpenGL 3\.3 context"):
        required_machine(lambda: None)
    plenty.setattr(resource, "getrlimit", lambda _kind: (600 * MIB, 600 * MIB))
    with pytest.raises(TrilaneError) as raised:
        required_machine(lambda: None)
    assert str(raised.value).startswith("no OpenGL context could be made; memory is short: each process may have 600")
    assert raised.value.exit_code == 1


@dataclass
class Sent:
    """A link that keeps what a unit says."""

    told: list[Failed] = field(default_factory=list)

    @property
    def job_pipe(self) -> Sent:
        return self

    def send(self, message: Failed) -> None:
        self.told.append(message)


@pytest.mark.parametrize(
    ("job", "error", "is_told"),
    [
        (BUILDING, MissingPartError("no OpenGL", "apt-get"), True),
        (BUILDING, BadInputError("net", "Unable to read the model", "one"), True),
        (7, MemoryError("x"), True),
        (7, OSError(errno.ENOMEM, "x"), True),
        (7, BadInputError("net", "no", "one"), False),
    ],
)
def test_a_unit_that_fails_where_memory_is_short_says_so(
    plenty: pytest.MonkeyPatch, job: int, error: Exception, is_told: bool
) -> None:
    """With what it failed with, but not with a package to install; a job's own error stays itself."""
    link = Sent()
    assert unit_loop._fail(link, job, "unit gpu", error) == getattr(error, "exit_code", 1)  # type: ignore[arg-type]
    assert "memory is short" not in link.told.pop().message
    plenty.setattr(resource, "getrlimit", lambda _kind: (600 * MIB, 600 * MIB))
    unit_loop._fail(link, job, "unit gpu", error)  # type: ignore[arg-type]
    message = link.told.pop().message
    assert message.startswith("unit gpu: memory is short: each process may have 600 MiB") == is_told
    assert "apt-get" not in message


def test_a_unit_that_ends_before_the_run_where_memory_is_short_says_so(plenty: pytest.MonkeyPatch) -> None:
    processes = SimpleNamespace(listen=lambda _ms: [("gpu", None)], why_ended=lambda _unit: "; it wrote last: x")
    with pytest.raises(TrilaneError, match=r"^unit gpu ended before the run began; it wrote last: x$"):
        listen_before_run(processes, SimpleNamespace(count=0))  # type: ignore[arg-type]
    plenty.setattr(machine.here, "oom_kills", lambda: machine._KILLS + 1)
    with pytest.raises(TrilaneError, match=r"^unit gpu ended before the run began; memory is short: the system has"):
        listen_before_run(processes, SimpleNamespace(count=0))  # type: ignore[arg-type]


def test_an_unexpected_error_is_no_defect_where_memory_is_short(plenty: pytest.MonkeyPatch) -> None:
    assert describe(ValueError("x"))[0].endswith("this is a defect of Trilane, --debug shows where")
    assert describe(MemoryError("cannot have 3 GB")) == ("memory is short: cannot have 3 GB", 1)
    plenty.setattr(resource, "getrlimit", lambda _kind: (600 * MIB, 600 * MIB))
    said, code = describe(ImportError("failed to map segment from shared object"))
    assert code == 1 and said.startswith("memory is short: each process may have 600 MiB of addresses")
    assert said.endswith("; ImportError: failed to map segment from shared object")
    assert describe(TrilaneError("its own reason"))[0] == "its own reason"


@pytest.mark.parametrize("limit_mb", [100, 200, 300, 500])
def test_a_run_without_room_for_its_libraries_says_how_much_it_needs(limit_mb: int, tmp_path: Path) -> None:
    """OpenBLAS ends a process, NumPy raises MemoryError, and EGL finds no driver, as the limit rises."""

    def limited() -> None:
        resource.setrlimit(resource.RLIMIT_AS, (limit_mb * MIB, limit_mb * MIB))

    command = [sys.executable, "-m", "trilane", "run", "--frames", "4"]
    done = subprocess.run(command, cwd=tmp_path, preexec_fn=limited, capture_output=True, text=True, check=False)
    found = f"found a limit of {limit_mb} MiB of addresses (ulimit -v), expected at least 1700 MiB for a run"
    assert (done.returncode, done.stderr) == (1, f"error: memory: {found}: ulimit -v unlimited\n")
    assert list(tmp_path.iterdir()) == []


def group(root: Path, said: str, **limits: str) -> Machine:
    """A machine whose process is in the groups that `said` lists. `limits`: by path, `__` for a slash."""
    (root / "proc/self").mkdir(parents=True)
    (root / "proc/self/cgroup").write_text(said)
    for path, text in limits.items():
        file = root / "sys/fs/cgroup" / path.replace("__", "/").replace("_dot_", ".")
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text(text + "\n")
    return Machine(root)


def test_the_least_limit_of_the_control_groups_counts(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Machine, "memory_bytes", lambda _self: 8 << 30)
    none = "9223372036854771712"
    two = group(tmp_path / "2", "0::/a/b\n", a__b__memory_dot_max="max", a__memory_dot_max=GIGABYTE)
    assert two.memory_limit_bytes() == 1 << 30
    one = group(
        tmp_path / "1",
        "5:cpu:/a\n4:memory:/a\n0::/\n",
        memory__a__memory_dot_limit_in_bytes=none,
        memory__memory_dot_limit_in_bytes="4096",
    )
    assert one.memory_limit_bytes() == 4096
    free = group(tmp_path / "0", "4:memory:/\n", memory__memory_dot_limit_in_bytes=none)
    assert free.memory_limit_bytes() is None
    assert Machine(tmp_path / "nothing").memory_limit_bytes() is None


def test_the_kernel_counts_what_it_ended(tmp_path: Path) -> None:
    (tmp_path / "proc").mkdir()
    (tmp_path / "proc/vmstat").write_text("nr_free_pages 12\noom_kill 3\nswap_ra 0\n")
    assert Machine(tmp_path).oom_kills() == 3
    assert Machine(tmp_path / "nothing").oom_kills() == 0
