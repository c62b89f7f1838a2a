"""Each cause of idleness that a journal can name has words, a pattern and a colour on the dashboard's page."""

from __future__ import annotations

import re
from pathlib import Path

from trilane.apps.dashboard import page
from trilane.pipeline.unit_history import IDLE_CAUSES, JOIN, UNEXPLAINED

PAGE = Path(page.__path__[0])


def keys_of(file: str, table: str) -> set[str]:
    """The keys of an object of the page's JavaScript, without those of objects in it."""
    text = (PAGE / file).read_text(encoding="utf-8")
    body = text.partition(f"const {table} = {{\n")[2].partition("\n};")[0]
    return set(re.findall(r"^  (\w+):", body, re.MULTILINE))


def test_every_cause_has_words_a_pattern_and_a_colour() -> None:
    causes = {*IDLE_CAUSES, JOIN, UNEXPLAINED}
    assert keys_of("slices.js", "CAUSE_MEANINGS") == keys_of("patterns.js", "STROKES") == causes
    styles = (PAGE / "style.css").read_text(encoding="utf-8")
    colours = dict(re.findall(r"--cause-(\w+): (light-dark\([^)]*\))", styles))
    assert set(colours) == causes and len(set(colours.values())) == len(causes)
