"""The documents are one site without a broken link, and each record of a decision begins as the index says."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

from trilane import machine

ROOT = Path(__file__).resolve().parents[2]
#: Pages outside the site.
OUTSIDE = ("README.md", "CONTRIBUTING.md", "SECURITY.md", "tests/README.md")
RECORDS = sorted(file for file in (ROOT / "docs" / "decisions").glob("*.md") if file.name != "index.md")
INDEX = (ROOT / "docs" / "decisions" / "index.md").read_text(encoding="utf-8")
HEAD = re.compile(r"# (.+)\n\n- \*\*What:\*\* (.+)\n- \*\*Why:\*\* .+\n- \*\*Figure:\*\* .+\n\n")
LINK = re.compile(r"\]\((?!https?:)([^)#\s]+)")


@pytest.mark.skipif(
    not machine.here.has_package("mkdocs") or not machine.here.has_package("material"),
    reason="the extra docs is not installed",
)
def test_the_site_is_built_with_strict_links_and_asks_no_other_host(tmp_path: Path) -> None:
    # with --quiet no warning is logged, and --strict counts what is logged: a broken link would pass
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "--site-dir", str(tmp_path / "site")]
    environment = {**os.environ, "NO_MKDOCS_2_WARNING": "1", "PYTHONWARNINGS": "default"}
    done = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True, check=False, timeout=120)
    assert done.returncode == 0, done.stdout + done.stderr
    pages = list((tmp_path / "site").rglob("*.html"))
    loaded = re.compile(r'<(?:script|link|img)\b[^>]*(?:src|href)="https?:[^"]*"')
    assert len(pages) > 90
    assert [found for page in pages for found in loaded.findall(page.read_text(encoding="utf-8"))] == []


@pytest.mark.parametrize("name", OUTSIDE)
def test_links_of_pages_outside_the_site_lead_to_files(name: str) -> None:
    page = ROOT / name
    links = LINK.findall(page.read_text(encoding="utf-8"))
    assert [link for link in links if not (page.parent / link).exists()] == []


def test_pages_name_files_that_exist() -> None:
    """Tests by their name, other files of this repository by their path."""
    there = {file.name for file in (ROOT / "tests").rglob("test_*.py")}
    outside = [ROOT / name for name in OUTSIDE]  # the changelog names what older versions had
    for page in (*outside, *(ROOT / "docs").rglob("*.md")):
        text = page.read_text(encoding="utf-8")
        assert {name for name in re.findall(r"\btest_\w+\.py\b", text) if name not in there} == set(), page
        paths = re.findall(r"`((?:apps|bench|docs|pipeline|scene|scheduler|src|stages|tests)/[\w./-]+\.\w+)`", text)
        assert {path for path in paths if not (ROOT / path).exists()} == set(), page


@pytest.mark.parametrize("record", RECORDS, ids=lambda file: file.stem)
def test_a_record_begins_with_what_why_and_a_figure_as_the_index_has_it(record: Path) -> None:
    head = HEAD.match(record.read_text(encoding="utf-8"))
    assert head is not None
    assert f"| [{head[1]}]({record.name}) | {head[2]}" in INDEX
