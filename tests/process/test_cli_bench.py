"""`trilane bench`: every bench is listed and asked by its own options."""

from __future__ import annotations

import importlib
import inspect
import sys

import pytest

from trilane.apps.cli import main as cli
from trilane.apps.cli.bench import BENCHES, MEANINGS, bench_command, meaning


def parameters(name: str) -> set[str]:
    return set(inspect.signature(importlib.import_module(BENCHES[name][0]).measure).parameters)


@pytest.mark.parametrize("name", BENCHES)
def test_options_are_the_parameters_of_measure_and_each_has_a_line(name: str) -> None:
    options = {option.name: option for option in bench_command(name).params}
    assert set(options) == parameters(name) | {"json"}
    assert all(options[parameter].help.startswith(meaning(name, parameter)) for parameter in parameters(name))


def test_no_line_is_without_its_option() -> None:
    spoken = {option for name in BENCHES for own in parameters(name) for option in (own, f"{name} {own}")}
    assert set(MEANINGS) <= spoken


@pytest.mark.parametrize("arguments", [("nothing",), ("scheduler", "--seeds", "0"), ("scheduler", "--seeds", "many")])
def test_bad_questions(monkeypatch: pytest.MonkeyPatch, arguments: tuple[str, ...]) -> None:
    monkeypatch.setattr(sys, "argv", ["trilane", "bench", *arguments])
    with pytest.raises(SystemExit, match="2"):
        cli.main()


@pytest.mark.parametrize("name", BENCHES)
def test_help_says_what_is_measured(name: str) -> None:
    """The line of the list, the module's question, and what `measure` answers; no option is without its line."""
    command = bench_command(name)
    line, question, answer = (command.help or "").split("\n\n", 2)
    assert line == BENCHES[name][1]
    assert question.endswith("?")
    assert answer
    assert "Raises" not in answer
    assert all(option.help for option in command.params)
