"""The parts of an error's sentence are its fields, wherever the error comes from."""

from __future__ import annotations

import errno
import pickle
from pathlib import Path
from typing import Any

import pytest
from pydantic import BaseModel, ValidationError, field_validator

from trilane.errors import BadInputError, MissingPartError, TrilaneError, UnitLostError, did_you_mean, reason
from trilane.hw_profiles.profile_files import merged_tables, parse_profile, profile_folder
from trilane.unexpected_value import UnexpectedValue, unexpected_in


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


def test_the_nearest_word_is_suggested_and_none_that_is_far() -> None:
    """difflib's ratio is twice the letters in common over the letters of both words; 0.6 and more are near."""
    known = ["single", "double", "triple"]
    assert did_you_mean("tripel", known) == "did you mean 'triple'?"  # 2 * 5 / 12
    assert did_you_mean("doub", known) == "did you mean 'double'?"  # 2 * 4 / 10
    assert did_you_mean("dbl", known) == "did you mean 'double'?"  # 2 * 3 / 9
    assert did_you_mean("lifo", known) == ""  # at most 2 * 1 / 10
    assert did_you_mean("", known) == did_you_mean("single", []) == ""
    assert did_you_mean("f", known) == did_you_mean("", ["f"]) == ""
    assert did_you_mean("fov", ["fov_y_deg", "far_m"]) == "did you mean 'fov_y_deg'?"  # 2 * 3 / 12, but its beginning
    assert did_you_mean("wa", ["wave-and-turn", "walk-and-turn"]) == ""  # the beginning of both
    assert did_you_mean("fra", ["far", "orbit"], "builtin:") == "did you mean 'builtin:far'?"  # 2 * 2 / 6
