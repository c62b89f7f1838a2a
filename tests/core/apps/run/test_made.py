"""When, by which command and by which Trilane: of a checkout its revision, of anything else none."""

from __future__ import annotations

import subprocess
from datetime import datetime, timedelta
from pathlib import Path

import pytest

from trilane import machine
from trilane.apps.run.report_facts import made_facts


def git(folder: Path, *words: str) -> str:
    command = ["git", "-C", str(folder), "-c", "user.name=a", "-c", "user.email=a@b.example", *words]
    return subprocess.run(command, check=True, capture_output=True, text=True).stdout.strip()


@pytest.fixture
def checkout(tmp_path: Path) -> Path:
    git(tmp_path, "init", "--quiet")
    (tmp_path / "file").write_text("first")
    git(tmp_path, "add", "file")
    git(tmp_path, "commit", "--quiet", "--message", "first")
    return tmp_path


def test_a_checkout_has_a_revision_and_is_modified_when_a_file_of_it_is(checkout: Path) -> None:
    (checkout / "notes of mine").write_text("not git's")
    clean = made_facts(["trilane", "run"], checkout)
    assert (clean["revision"], clean["modified"]) == (git(checkout, "rev-parse", "HEAD"), False)
    (checkout / "file").write_text("second")
    assert made_facts([], checkout)["modified"] is True


def test_what_is_no_checkout_has_no_revision_though_a_folder_above_is_one(checkout: Path) -> None:
    installed = checkout / "site-packages"
    installed.mkdir()
    facts = made_facts(["trilane", "run", "--out", "a b"], installed)
    assert (facts["revision"], facts["modified"]) == (None, None)
    assert facts["command"] == ["trilane", "run", "--out", "a b"]
    assert timedelta(0) <= machine.here.now() - datetime.fromisoformat(facts["at"]) < timedelta(minutes=5)


def test_a_command_of_this_checkout_has_its_revision() -> None:
    root = Path(__file__).resolve().parents[4]
    expected = git(root, "rev-parse", "HEAD") if (root / ".git").exists() else None
    assert (root / "apps").is_dir() and made_facts([])["revision"] == expected


def test_without_git_or_with_a_broken_checkout_nothing_fails(checkout: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (checkout / ".git" / "HEAD").write_text("nonsense")
    assert made_facts([], checkout)["revision"] is None
    monkeypatch.setattr(machine.here, "program", lambda _name: None)
    assert made_facts([], checkout)["revision"] is None
