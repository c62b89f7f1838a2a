"""Data of the house as a whole: every profile's numbers are held."""

from __future__ import annotations

import tomllib
from collections.abc import Callable, Iterator
from typing import Any

import pytest

from trilane.hw_profiles.profile_files import profile_folder, profile_names


def leaves(data: Any, key: str = "") -> Iterator[tuple[str, Any]]:
    if isinstance(data, dict):
        for name, value in data.items():
            yield from leaves(value, f"{key}.{name}")
    elif isinstance(data, list):
        for number, value in enumerate(data):
            yield from leaves(value, f"{key}[{number}]")
    else:
        yield key, data


@pytest.mark.parametrize("name", profile_names())
def test_the_numbers_and_words_of_a_profile_are_held(held: Callable[[str, Any], None], name: str) -> None:
    """Words by the numbers of their letters, so that one file holds all."""
    data = tomllib.loads((profile_folder() / f"{name}.toml").read_text(encoding="utf-8"))
    found = sorted(leaves(data))
    held("keys", [sum(key.encode()) for key, _ in found])
    held("numbers", [value for _, value in found if isinstance(value, int | float)])
    held("words", [sum(value.encode()) for _, value in found if isinstance(value, str)])
