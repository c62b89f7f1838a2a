"""README.md is short, and no figure or output in it was typed: each marked block is as `make readme` writes it."""

from __future__ import annotations

import re
from collections.abc import Callable

import pytest

from support.readme import README, ROOT, block, contents, filled

TEXT = README.read_text(encoding="utf-8")
MOST_LINES = 150


@pytest.fixture(scope="module")
def made() -> dict[str, str]:
    """The blocks, made again: computed ones by the commands, measured ones from the record of their run."""
    return contents()


def test_each_block_is_as_it_is_written(made: dict[str, str]) -> None:
    for name, content in made.items():
        assert block(TEXT, name) == content, f"block {name}: `make readme` writes it; it is not edited by hand"
    assert TEXT.count(": written by make readme") == len(made)


def test_a_changed_figure_is_noticed_and_written_again(made: dict[str, str]) -> None:
    for name, content in made.items():
        digit = re.search(r"\d", content)
        assert digit, f"block {name} has no figure"
        changed = content[: digit.start()] + str(9 - int(digit[0])) + content[digit.end() :]
        edited = filled(TEXT, {name: changed})
        assert block(edited, name) != content
        assert filled(edited, made) == TEXT


@pytest.mark.parametrize("spoil", [lambda text: text.replace("<!-- end of sizes -->", ""), lambda text: text + text])
def test_a_block_that_is_missing_or_doubled_is_named(spoil: Callable[[str], str]) -> None:
    with pytest.raises(ValueError, match=r"block sizes: found [02], expected 1"):
        block(spoil(TEXT), "sizes")


def test_it_is_short_and_its_links_lead_somewhere() -> None:
    assert len(TEXT.splitlines()) <= MOST_LINES
    links = [link.partition("#")[0] for link in re.findall(r"\]\(([^)]+)\)", TEXT) if "://" not in link]
    assert [link for link in links if link and not (ROOT / link).exists()] == []
