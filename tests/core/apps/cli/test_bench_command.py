"""`trilane bench`: what a bench that a test makes up is asked and prints; numbers out of range are refused by name."""

from __future__ import annotations

import io
import json
from collections.abc import Callable
from typing import Any

import pytest
from rich.console import Console

from trilane.apps.cli import bench
from trilane.apps.cli.bench import MEANINGS, show
from trilane.bench import LIMITS, check_limits
from trilane.errors import BadInputError
from trilane.stages import machine_facts

Command = Callable[..., tuple[str, str]]


def test_a_bench_is_asked_by_its_options(monkeypatch: pytest.MonkeyPatch, command: Command) -> None:
    """Of the bench `several`, with another measure: options as values of their types, results beside the machine."""
    from trilane.bench import several

    asked: list[dict[str, Any]] = []

    def measure(views: int = 3, seconds: float = 1.5, size: str = "256", spin: bool = False, rounds: tuple = (1, 2)):  # type: ignore[no-untyped-def, type-arg]
        """Rows."""
        asked.append({"views": views, "seconds": seconds, "size": size, "spin": spin, "rounds": rounds})
        return {"rows": [], "driver": {"renderer": "r"}, "share": 1 / 3, "inner": {"a": 1}, "tag": "[x]"}

    monkeypatch.setattr(several, "measure", measure)
    monkeypatch.setattr(machine_facts, "machine_facts", lambda gl: {"cpu": {"model": "a cpu", "cores": 2}, "gl": gl})
    out, _ = command("bench", "several", "--json")
    assert json.loads(out) == {
        "bench": "several",
        "rows": [],
        "driver": {"renderer": "r"},
        "share": 1 / 3,
        "inner": {"a": 1},
        "tag": "[x]",
        "machine": {"cpu": {"model": "a cpu", "cores": 2}, "gl": {"renderer": "r"}},
    }
    words = ("--views", 7, "--seconds", 0.25, "--size", "64", "--spin", "--rounds", 5, "--rounds", 6)
    out, _ = command("bench", "several", *words)
    assert [dict(row, rounds=list(row["rounds"])) for row in asked] == [
        {"views": 3, "seconds": 1.5, "size": "256", "spin": False, "rounds": [1, 2]},
        {"views": 7, "seconds": 0.25, "size": "64", "spin": True, "rounds": [5, 6]},
    ]
    lines = ["driver.renderer: r", "share: 0.3333", "inner.a: 1", "tag: [x]", "cpu: a cpu, 2 cores"]
    assert out.splitlines() == lines


def test_the_group_knows_its_benches_and_nothing_else(command: Command) -> None:
    out, err = command("bench", "nothing", code=2)
    assert (out, "No such command 'nothing'" in err) == ("", True)
    out, err = command("bench", code=2)
    assert "Measure this machine; each result includes facts about it." in out + err


def test_a_table_of_many_columns_is_turned_and_has_no_header() -> None:
    """Ten columns are rows; of a value that a row does not have the place is blank."""
    rows = [{f"column {n}": n for n in range(10)}, {"column 0": 0.25, "column 9": "[x]"}]
    console = Console(width=60, markup=False, file=io.StringIO())
    console.print(bench._table(rows))
    lines = [line.strip("┌┐└┘│├┤─┬┴┼ ").split("│") for line in console.file.getvalue().splitlines()]  # type: ignore[attr-defined]
    told = [[cell.strip() for cell in line] for line in lines if line != [""]]
    assert [line[0] for line in told] == [f"column {n}" for n in range(10)]
    assert (
        told[0] == ["column 0", "0", "0.25"]
        and told[9] == ["column 9", "9", "[x]"]
        and told[1][:2] == ["column 1", "1"]
    )


def test_a_table_of_few_columns_has_their_names() -> None:
    console = Console(width=60, markup=False, file=io.StringIO())
    console.print(bench._table([{"a": 1, "b": 2.0}, {"a": 3}]))
    words = console.file.getvalue().translate(str.maketrans(dict.fromkeys("┏┓┗┛┃┡┩━┳╇└┘│─┴", " "))).split()  # type: ignore[attr-defined]
    assert words == ["a", "b", "1", "2", "3"]


@pytest.mark.parametrize(
    "asked",
    [{"width": -3}, {"batch": 0}, {"repeats": 0}, {"threads": -1}, {"minutes": float("nan")}, {"sizes": (64, 0)}],
)
def test_a_number_out_of_range_is_refused_by_name(asked: dict[str, object]) -> None:
    def never(**_: object) -> dict[str, object]:
        raise AssertionError("measured")

    with pytest.raises(BadInputError, match=f"--{next(iter(asked))}: found .* expected .* to "):
        show("raster", never, asked, as_json=True)


def test_what_has_no_range_is_left_to_the_bench() -> None:
    check_limits({"network": "x.onnx", "spin": True, "size": ("256x256",), "repeats": 5})
    assert all(low < high for low, high in LIMITS.values())
    assert set(LIMITS) <= {name.split(" ")[-1] for name in MEANINGS}
