"""The parts of an error's sentence are its fields, wherever the error comes from."""

from __future__ import annotations

import ast
import errno
import pickle
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from pydantic import BaseModel, ValidationError, field_validator

import trilane
from trilane.errors import BadInputError, MissingPartError, TrilaneError, UnitLostError, reason
from trilane.hw_profiles.profile_files import merged_tables, parse_profile, profile_folder
from trilane.scene.schema import scene_from
from trilane.scheduler.events import Graph, StageSpec
from trilane.scheduler.policy import policy_named
from trilane.shapes import parse_shape, shape_buckets
from trilane.transport.slots import edge_rule
from trilane.unexpected_value import UnexpectedValue, unexpected_in

PACKAGE = Path(trilane.__file__).parent


def test_the_sentence_is_built_from_the_fields() -> None:
    error = BadInputError(Path("a.toml"), "3", "4", "add one")
    assert (error.where, error.found, error.expected, error.remedy) == ("a.toml", "3", "4", "add one")
    assert str(error) == "a.toml: found 3, expected 4; add one"
    assert str(BadInputError("a", "3", "4")) == "a: found 3, expected 4"
    assert str(UnexpectedValue("3", "4")) == "found 3, expected 4"
    assert str(UnexpectedValue("3", "4", "add one")) == "found 3, expected 4; add one"


def test_a_long_find_is_shown_without_its_middle() -> None:
    assert BadInputError("a", "x" * 500, "4").found == "x" * 500
    assert BadInputError("a", "b" * 400 + "m" * 5000 + "e" * 100, "4").found == "b" * 400 + " … " + "e" * 100


def test_a_place_is_added_and_the_parts_stay() -> None:
    error = BadInputError.at("--size", UnexpectedValue("a, expected b", "c, found d", "mend it"))
    assert (error.where, error.found, error.expected) == ("--size", "a, expected b", "c, found d")
    assert error.remedy == "mend it"


@pytest.mark.parametrize(
    "error",
    [
        BadInputError("a", "3", "4", "add one"),
        UnexpectedValue("3", "4", "add one"),
        MissingPartError("no engine", "apt-get install engine"),
        TrilaneError("it failed"),
    ],
)
def test_an_error_goes_from_process_to_process_as_it_is(error: Exception) -> None:
    copy = pickle.loads(pickle.dumps(error))  # noqa: S301 - our own
    assert type(copy) is type(error)
    assert (str(copy), copy.args, vars(copy)) == (str(error), error.args, vars(error))


RAISED: dict[str, tuple[Callable[[], object], str, str]] = {
    "shape": (lambda: parse_shape("3 by 4"), "'3 by 4'", "HEIGHTxWIDTH such as 256x256"),
    "side": (lambda: shape_buckets("100"), "side 100", "a multiple of 32 from 32 to 4096"),
    "edge": (lambda: edge_rule("quad"), "edge 'quad'", "single, double, triple, fifo:N or orphan:N"),
    "edge's count": (lambda: edge_rule("fifo:99"), "edge 'fifo:99'", "fifo:N with N from 1 to 64"),
    "policy": (lambda: policy_named("x"), "policy 'x'", "one of sequential, pipelined, latest, deadline"),
    "stages": (
        lambda: Graph((StageSpec("a", "cpu"),) * 2, ("double",), "a"),
        "stages ['a', 'a']",
        "different names",
    ),
    "edges": (
        lambda: Graph((StageSpec("a", "cpu"),), (), "b"),
        "0 edges and latency to 'b' for stages ['a']",
        "one edge fewer than stages, and latency to one of them",
    ),
}


@pytest.mark.parametrize("case", RAISED)
def test_what_is_raised_without_a_place(case: str) -> None:
    call, found, expected = RAISED[case]
    with pytest.raises(UnexpectedValue) as raised:
        call()
    assert (raised.value.found, raised.value.expected) == (found, expected)


class _Even(BaseModel):
    number: int

    @field_validator("number")
    @classmethod
    def _is_even(cls, number: int) -> int:
        if number < 0:
            raise ValueError("below zero")
        if number % 2:
            raise UnexpectedValue(f"{number}, expected by nobody", "an even number", "add one")
        return number


@pytest.mark.parametrize("value", [3, -2, "x", None])
def test_pydantic_hands_the_error_on_as_it_was_raised(value: Any) -> None:
    with pytest.raises(ValidationError) as raised:
        _Even(number=value)
    unexpected = unexpected_in(raised.value.errors()[0])
    if value != 3:
        assert unexpected is None
        return
    assert unexpected is not None
    assert unexpected.found == "3, expected by nobody"
    assert (unexpected.expected, unexpected.remedy) == ("an even number", "add one")


SCENES: dict[str, tuple[dict[str, Any], str]] = {
    "a validator's own": (
        {"size": "100"},
        "s: size: found side 100, expected a multiple of 32 from 32 to 4096, or auto",
    ),
    "of two keys": (
        {"camera": {"near_m": 2, "far_m": 1}},
        "s: camera: found near_m 2 and far_m 1, expected near_m below far_m and far_m at most 1e+06 times near_m",
    ),
    "the schema's": ({"frames": 0}, "s: frames: found 0, expected greater than or equal to 1"),
    "unknown key": (
        {"size_": 1},
        "s: size_: found an unknown key, expected a key of the scene schema; did you mean 'size'?",
    ),
    "key like no other": (
        {"zzz": 1},
        "s: zzz: found an unknown key, expected a key of the scene schema; correct its spelling or remove it",
    ),
}


@pytest.mark.parametrize("case", SCENES)
def test_a_scene_says_the_whole_sentence(case: str) -> None:
    values, said = SCENES[case]
    with pytest.raises(BadInputError) as raised:
        scene_from("s", values)
    assert str(raised.value) == said


def test_a_profile_says_how_much_more_is_wrong_as_the_remedy() -> None:
    path = profile_folder() / "snapdragon-888.toml"
    tables = merged_tables(path)
    tables["units"]["gpu"]["idle_w"]["value"] = -1.0
    tables["units"]["dsp"]["idle_w"]["value"] = 2000.0
    with pytest.raises(BadInputError) as raised:
        parse_profile(tables, path)
    error = raised.value
    assert error.where.startswith(f"{path}: units.")
    assert (error.found, error.expected) in {("-1", "0 to 1000"), ("2000", "0 to 1000")}
    assert error.remedy == "and 1 more"
    assert str(error).endswith(", expected 0 to 1000; and 1 more")


def test_a_profile_with_an_unknown_key() -> None:
    path = profile_folder() / "snapdragon-888.toml"
    tables = merged_tables(path)
    tables["units"]["gpu"]["idle"] = 1.0
    with pytest.raises(BadInputError) as raised:
        parse_profile(tables, path)
    assert raised.value.remedy == "units of measure end the name"
    assert (raised.value.found, raised.value.expected) == ("the unknown key `idle`", "`idle_w`")


@pytest.mark.parametrize(
    ("error", "words"),
    [
        (OSError(errno.ENOENT, "No such file or directory", "/a/B"), "no such file or directory"),
        (OSError(errno.EIO, "Input/output error"), "input/output error"),
        (OSError("Cannot write /A/B"), "cannot write /A/B"),
        (OSError(), ""),
        (ValueError("No number"), "No number"),
    ],
)
def test_a_systems_error_in_words(error: Exception, words: str) -> None:
    assert reason(error) == words


def test_a_systems_error_about_a_file(tmp_path: Path) -> None:
    path = tmp_path / "none"
    with pytest.raises(FileNotFoundError) as raised:
        path.read_bytes()
    error = BadInputError.of_os_error(path, raised.value, "a file", "make it")
    assert str(error) == f"{path}: found no such file or directory, expected a file; make it"


def test_each_kind_of_error_has_its_exit_code() -> None:
    """README: 1 the run failed, 2 wrong input, 3 something is missing."""
    kinds = (TrilaneError, UnitLostError, BadInputError, MissingPartError)
    assert [kind.exit_code for kind in kinds] == [1, 1, 2, 3]


def test_a_missing_part_names_a_line_or_an_extra() -> None:
    assert str(MissingPartError("no EGL", "apt-get install x")) == "no EGL; install it with: apt-get install x"
    assert MissingPartError("no anny", extra="anny").install.endswith("[anny]'")


def calls(tree: ast.AST) -> list[str]:
    """What the code says of each string that it splits, strips or formats by `found` and `expected`."""
    wanted = {"partition", "removeprefix", "split", "startswith"}
    nodes = [node for node in ast.walk(tree) if isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute)]
    asked = [node for node in nodes if isinstance(node.func, ast.Attribute) and node.func.attr in wanted]
    words = [arg.value for node in asked for arg in node.args if isinstance(arg, ast.Constant)]
    return [word for word in words if isinstance(word, str) and ("found " in word or "expected " in word)]


def test_no_code_reads_the_parts_out_of_a_text() -> None:
    files = [
        file for folder in (PACKAGE, *(p for p in PACKAGE.iterdir() if p.is_dir())) for file in folder.rglob("*.py")
    ]
    assert len(files) > 200
    assert {str(file): found for file in files if (found := calls(ast.parse(file.read_text(encoding="utf-8"))))} == {}
