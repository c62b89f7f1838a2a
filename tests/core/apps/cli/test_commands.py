"""Every command: its options have a help, and one that takes one value is refused when it is given twice."""

from __future__ import annotations

from collections.abc import Iterator
from enum import Enum
from typing import Annotated, Any

import pytest
import typer

from trilane.apps.cli import bench, main
from trilane.apps.cli.commands import Commands, OnceCommand
from trilane.errors import BadInputError


def commands() -> Iterator[tuple[str, Any]]:
    """Every command of the command line, by the words that call it."""
    for name in main.COMMANDS:
        command = main.command_of(name)
        if name == "bench":
            yield from ((f"bench {one}", bench.bench_command(one)) for one in bench.BENCHES)
        elif hasattr(command, "commands"):
            yield from ((f"{name} {one}", each) for one, each in command.commands.items())
        else:
            yield name, command


def single_valued(command: Any) -> Iterator[list[str]]:
    """The names of each option that takes one value; of a flag with an opposite, both."""
    for option in command.params:
        if option.param_type_name == "option" and not option.multiple:
            names = [*option.opts, *option.secondary_opts]
            if not option.is_flag or option.secondary_opts:
                yield names if option.is_flag else [f"{name}=1" for name in names]


def test_every_option_is_explained_and_refused_twice() -> None:
    tried = 0
    for words, command in commands():
        assert isinstance(command, OnceCommand), words
        assert command.help, words
        assert [option.name for option in command.params if not option.help] == [], words
        for spellings in single_valued(command):
            tried += 1
            twice = [spellings[0], spellings[-1]]
            with pytest.raises(BadInputError, match=f"{spellings[0].removesuffix('=1')}.* given 2 times"):
                command.make_context(words, twice)
    assert tried > 100


def empties(command: Any) -> Iterator[list[str]]:
    """Words in which one argument, or one path of an option, is empty."""
    arguments = [each for each in command.params if each.param_type_name == "argument"]
    yield from (["x"] * place + [" "] for place in range(len(arguments)))
    for option in command.params:
        if option not in arguments and "Path" in str(option.type_descriptor.annotation):
            yield [f"{option.opts[0]}="]


def test_an_empty_path_is_refused_everywhere() -> None:
    """Before anything is read: as a path it would be the working directory."""
    tried = 0
    for words, command in commands():
        for empty in empties(command):
            tried += 1
            with pytest.raises(BadInputError, match="found an empty path, expected a file or a folder"):
                command.make_context(words, empty)
    assert tried > 60


@pytest.fixture
def seen() -> list[dict[str, Any]]:
    return []


@pytest.fixture
def command(seen: list[dict[str, Any]]) -> Any:
    """One value, several values, a flag with an opposite and one without."""
    app = Commands()

    @app.command()
    def both(
        one: str = "a",
        several: list[str] = ["b"],  # noqa: B006
        hud: bool = True,
        json: Annotated[bool, typer.Option("--json")] = False,
    ) -> None:
        seen.append({"one": one, "several": several, "hud": hud, "json": json})

    return typer.main.get_command(app)


def test_what_collects_values_and_what_says_the_same_again_may_be_repeated(
    command: Any, seen: list[dict[str, Any]]
) -> None:
    words = ["--several", "x", "--several", "y", "--one", "1", "--json", "--json", "--no-hud"]
    command.main(words, standalone_mode=False)
    assert seen == [{"one": "1", "several": ["x", "y"], "hud": False, "json": True}]


@pytest.mark.parametrize(
    ("words", "named"), [(["--one", "1", "--one=1"], "--one"), (["--hud", "--no-hud"], "--hud or --no-hud")]
)
def test_a_second_value_is_refused_though_it_is_the_same(command: Any, words: list[str], named: str) -> None:
    with pytest.raises(BadInputError) as refused:
        command.main(words, standalone_mode=False)
    assert str(refused.value) == f"options: found {named} given 2 times, expected it once; it takes one value"
    assert refused.value.exit_code == 2


class Size(Enum):
    SMALL = "small"
    LARGE = "large"


def test_a_value_of_another_kind_is_said_as_everywhere() -> None:
    """Found, expected, and for a misspelt word the one that was probably meant."""
    app = Commands()

    @app.command()
    def one(
        size: Annotated[Size, typer.Option()] = Size.SMALL,
        count: int = 1,
        share: Annotated[float, typer.Option(min=0, max=2)] = 0.0,
    ) -> None: ...

    for words, sentence in (
        (["--size", "smal"], "--size: found 'smal', expected one of small, large; did you mean 'small'?"),
        (["--size", "7"], "--size: found '7', expected one of small, large"),
        (["--count", "abc"], "--count: found 'abc', expected a whole number"),
        (["--share", "2.5"], "--share: found '2.5', expected less than or equal to 2"),
    ):
        with pytest.raises(BadInputError) as refused:
            typer.main.get_command(app).main(words, standalone_mode=False)
        assert str(refused.value) == sentence
