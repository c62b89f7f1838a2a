"""Whether a machine is what its row of tests/machines.toml asks for: the first test of each row, named after it.

Not run by `make test`, on whose machine they would fail.
"""

from __future__ import annotations

import importlib
import importlib.metadata
import locale
import os
import stat
import sys
import time
import tomllib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

import trilane
from support.machines import lowest_versions
from trilane import machine
from trilane.apps.run.run_folder import RunFolder
from trilane.cache import cache_dir
from trilane.hw_profiles.profile_files import load_profile
from trilane.pipeline.job_times import availability
from trilane.pipeline.unit_starter import UnitStarter
from trilane.stages.dsp.runtime import installed
from trilane.stages.machine_facts import cpu_facts, package_version, runtime_facts
from trilane.writing import write_bytes, write_folder

ROOT = Path(__file__).resolve().parents[2]
DOT_PRODUCTS = {"avx512_vnni", "avx_vnni", "amx_int8", "asimddp", "i8mm"}


def here_and_in_units(function: Callable[[], Any]) -> list[Any]:
    """What a function of the product says in this process, and where units are forked."""
    with UnitStarter() as starter:
        return [function(), starter.call(f"{function.__module__}:{function.__name__}").result()]


def test_counters() -> None:
    assert here_and_in_units(availability) == ["instructions, cache_misses"] * 2


def test_counters_unreadable() -> None:
    assert here_and_in_units(availability) == ["instructions, cache_misses"] * 2
    file = machine.here.open_counter(bytes(64), 0)
    assert machine.here.read_counter(file, 24)
    with pytest.raises(ChildProcessError):
        machine.here.read_counter(file, 24)
    os.close(file)


def test_counters_refused() -> None:
    said = "absent: this process may not call perf_event_open, as in many containers"
    assert here_and_in_units(availability) == [said] * 2


def test_one_core() -> None:
    assert len(machine.here.cores()) == 1
    assert [len(facts["cores_allowed"]) for facts in here_and_in_units(cpu_facts)] == [1, 1]


def test_no_vnni() -> None:
    for facts in here_and_in_units(cpu_facts):
        assert not DOT_PRODUCTS & set(facts["flags"])


def test_no_openvino() -> None:
    assert package_version("openvino") is None
    assert [("openvino" in names, "ort" in names) for names in here_and_in_units(installed)] == [(False, True)] * 2
    assert list(runtime_facts()) == ["onnxruntime"]
    with pytest.raises(ModuleNotFoundError):
        importlib.import_module("openvino")


def test_no_home() -> None:
    assert cache_dir("tests") is None
    for place in (Path("~").expanduser(), machine.here.cache_home()):
        with pytest.raises(OSError):
            (place / "trilane").mkdir(parents=True, exist_ok=True)


def test_path() -> None:
    for path in (ROOT, Path(sys.executable), *map(Path, trilane.__path__)):
        assert " " in str(path)
        assert "ü" in str(path)


def test_c_locale(tmp_path: Path) -> None:
    """And a user's file is UTF-8 all the same."""
    assert locale.getlocale(locale.LC_CTYPE) == (None, None)
    with (tmp_path / "text").open("w") as file, pytest.raises(UnicodeEncodeError):
        file.write("ü")
    mine = tmp_path / "mine.toml"
    mine.write_text('extends = "snapdragon-888"\nname = "mine"\ntitle = "Prüfstand"\n', encoding="utf-8")
    assert load_profile(mine).title == "Prüfstand"


def test_time_zone() -> None:
    assert time.localtime().tm_gmtoff in (12 * 3600, 13 * 3600)


def test_umask(tmp_path: Path) -> None:
    """And nothing that the product writes is open to others."""
    (tmp_path / "file").touch()
    assert stat.S_IMODE((tmp_path / "file").stat().st_mode) == 0o600
    write_bytes(tmp_path / "written", b"1")
    with write_folder(tmp_path / "folder") as draft:
        (draft / "inside").touch()
    with RunFolder(tmp_path / "run") as run:
        (run.work / "report.json").touch()
        run.complete()
    modes = {path.name: stat.S_IMODE(path.stat().st_mode) for path in tmp_path.rglob("*")}
    assert {name for name, mode in modes.items() if mode & 0o077} == set()
    assert {"written", "folder", "inside", "run", "report.json"} <= set(modes)


def test_lowest() -> None:
    """Two numbers of a version say which it is: a pre-release or a fourth number would have others."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    asked = [line.split("==") for line in lowest_versions(project) if "==" in line]
    assert len(asked) > 15
    for name, version in asked:
        found = importlib.metadata.version(name)
        assert f"{found}.0.0".startswith(f"{version}."), (name, version, found)


def test_python_3_11() -> None:
    assert sys.version_info[:2] == (3, 11)


def test_python_3_13() -> None:
    assert sys.version_info[:2] == (3, 13)


def test_python_3_14() -> None:
    assert sys.version_info[:2] == (3, 14)
