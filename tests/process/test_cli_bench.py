"""`trilane bench`: every bench is listed, asked by its own options, and answers with the machine's facts."""

from __future__ import annotations

import json
import sys

import pytest

from trilane.apps.cli import main as cli
from trilane.apps.cli.bench import BENCHES, bench_command, flat


def run_here(monkeypatch: pytest.MonkeyPatch, *arguments: str) -> int:
    monkeypatch.setattr(sys, "argv", ["trilane", "bench", *arguments])
    with pytest.raises(SystemExit) as left:
        cli.main()
    return int(left.value.code or 0)


def test_help_lists_every_bench(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    assert run_here(monkeypatch, "--help") == 0
    text = capsys.readouterr().out
    assert all(name in text for name in BENCHES)


@pytest.mark.parametrize("name", ["raster", "readback", "raster-oracle", "crop", "joints"])
def test_options_are_the_parameters_of_measure(name: str) -> None:
    assert "json" in {parameter.name for parameter in bench_command(name).params}


def test_json_is_one_document_with_the_machine(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run_here(monkeypatch, "crop", "--views", "3", "--json") == 0
    document = json.loads(capsys.readouterr().out)
    assert document["bench"] == "crop"
    assert document["config"]["views"] == 3
    assert document["machine"]["cpu"]["cores"] >= 1


def test_a_table_for_people(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    assert run_here(monkeypatch, "crop", "--views", "3") == 0
    assert "wasted_median" in capsys.readouterr().out


@pytest.mark.parametrize("arguments", [("nothing",), ("crop", "--views", "0"), ("crop", "--views", "many")])
def test_bad_questions(monkeypatch: pytest.MonkeyPatch, arguments: tuple[str, ...]) -> None:
    assert run_here(monkeypatch, *arguments) == 2


def test_flat_joins_keys() -> None:
    assert flat({"a": {"b": 1, "c": {"d": 2}}, "e": 3}) == {"a.b": 1, "a.c.d": 2, "e": 3}
