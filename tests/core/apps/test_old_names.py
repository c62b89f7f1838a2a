"""Old names of commands and options: what each means now, that it is told once, and that no text of ours has one."""

from __future__ import annotations

import json
import re
import warnings
from collections.abc import Callable
from pathlib import Path

import pytest

import trilane
from trilane.apps.old_names import COMMANDS, OPTIONS, in_new_names
from trilane.errors import BadInputError

ROOT = Path(__file__).resolve().parents[3]
Command = Callable[..., tuple[str, str]]
#: Old command line -> new one. Words after `=` or a blank are values; a new meaning of an old word stays as it is.
LINES = {
    "top runs/walk --once --json": "watch runs/walk --once --json",
    "dashboard walk --port 8080": "show walk --port 8080",
    "accuracy closeup --runtime ort": "quality closeup --runtime ort",
    "run far --output 320x240": "run far --picture 320x240",
    "run --output=320x240 --runtime ort": "run --picture=320x240 --runtime ort",
    "predict --runtime gpu": "predict --unit gpu",
    "predict --runtime=all --network n.onnx": "predict --unit=all --network n.onnx",
    "predict --network n.onnx --engine-runtime qnn_dlc": "predict --network n.onnx --runtime qnn_dlc",
    "predict --runtime dsp --engine-runtime tflite": "predict --unit dsp --runtime tflite",
    "predict --network n.onnx --runtime qnn_dlc": "predict --network n.onnx --runtime qnn_dlc",
    "explain far": "plan far",
    "explain mine.toml --json": "plan mine.toml --json",
    "explain --size auto": "plan --size auto",
    "explain far --picture plan.png --output 320x240": "plan far --out plan.png --picture 320x240",
    "plan far --picture 320x240": "plan far --picture 320x240",
    "explain": "explain",
    "explain runs/walk --slowest 20": "explain runs/walk --slowest 20",
    "explain --jobs far --json": "explain --jobs far --json",
    "explain --slowest=3": "explain --slowest=3",
    "avatar create-data film --output 96x64": "avatar create-data film --picture 96x64",
    "avatar export default --out a.onnx": "avatar export default --out a.onnx",
    "sweep run --output 320x240 --output 640x480": "sweep run --picture 320x240 --picture 640x480",
    "sweep accuracy --dry-run": "sweep quality --dry-run",
    "sweep top.toml --dry-run": "sweep top.toml --dry-run",
    "tune fps predict --runtime gpu": "tune fps predict --unit gpu",
    "compare top dashboard": "compare top dashboard",
    "--help": "--help",
    "": "",
}


@pytest.mark.parametrize("old", LINES)
def test_a_command_line_by_new_names(old: str) -> None:
    notes: list[str] = []
    assert " ".join(in_new_names(old.split(), notes.append)) == LINES[old]
    assert bool(notes) == (old != LINES[old])


def test_every_name_of_the_table_is_tried() -> None:
    told: list[str] = []
    for line in LINES:
        in_new_names(line.split(), told.append)
    for old in (*(f"`trilane {name}`" for name in COMMANDS), *(each.old for each in OPTIONS)):
        assert any(text.startswith(f"{old} is called ") for text in told), old


def test_a_folder_with_the_name_of_a_scene_is_a_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "runs" / "far").mkdir(parents=True)
    assert in_new_names(["explain", "far"], pytest.fail) == ["explain", "far"]


def test_an_old_name_is_told_once_and_does_the_same(command: Command) -> None:
    new, said = command("sweep", "run", "--picture", "320x240", "--picture", "640x480", "--dry-run")
    assert said == ""
    old, said = command("sweep", "run", "--output", "320x240", "--output", "640x480", "--dry-run")
    assert old == new
    assert said == "note: --output is called --picture now; the old name is gone in Trilane 0.3\n"
    assert "Usage: trilane quality" in command("accuracy", "--help")[0]


def test_axes_of_a_sweep_file(tmp_path: Path, command: Command) -> None:
    file = tmp_path / "old.toml"
    axes = "[axes]\nruntime = ['dsp', 'gpu']\n"
    file.write_text(f"command = 'predict'\n[options]\nsize = 512\n{axes}")
    out, err = command("sweep", file, "--dry-run")
    assert [line.partition("--unit ")[2].split()[0] for line in out.splitlines()] == ["dsp", "gpu"]
    assert err == "note: runtime is called unit now; the old name is gone in Trilane 0.3\n"
    file.write_text(f"command = 'predict'\n{axes}unit = ['dsp']\n")
    assert "axes: found unit twice, expected it once" in command("sweep", file, "--dry-run", code=2)[1]
    file.write_text("command = 'accuracy'\n[axes]\nscene = ['far', 'closeup']\n")
    trials = command("sweep", file, "--dry-run")[0].splitlines()
    assert [trial.split()[1:4] for trial in trials] == [["trilane", "quality", each] for each in ("far", "closeup")]


def test_axes_of_a_search(tmp_path: Path, command: Command) -> None:
    pytest.importorskip("optuna")
    words = ("latency", "--on", "snapdragon-888", "--axis", "runtime=dsp,gpu", "--axis", "size=256", "--json")
    document = json.loads(command("tune", *words, "--out", tmp_path / "tuned")[0])
    assert {trial["options"]["unit"] for trial in document["trials"]} == {"dsp", "gpu"}


def test_a_program_is_warned_where_it_calls() -> None:
    with pytest.warns(DeprecationWarning, match="runtime is called unit now") as told:
        old = trilane.predict(runtime="gpu", size=256)
    assert told[0].filename == __file__
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert trilane.predict(unit="gpu", size=256).document == old.document
    with pytest.warns(DeprecationWarning, match="output is called picture now"), pytest.raises(BadInputError):
        trilane.run(output="12")


def command_lines() -> list[tuple[str, str]]:
    """Return (page or help, command line) of all command lines in the texts that users read."""
    pages = [ROOT / "README.md", *(ROOT / "docs").rglob("*.md"), ROOT / "tests" / "core" / "printed" / "helps.txt"]
    pattern = re.compile(r"(?:^\s*(?:\$ )?|`)trilane ([^`\n#]+)", re.MULTILINE)
    return [(page.name, line.strip()) for page in pages for line in pattern.findall(page.read_text())]


def test_no_text_has_an_old_name() -> None:
    lines = command_lines()
    assert len(lines) > 300
    told: list[str] = []
    for page, line in lines:
        in_new_names(
            re.sub(r"[\[\]…'\"]", " ", line).split(),
            lambda text, page=page, line=line: told.append(f"{page}: {line}: {text}"),
        )
    assert told == []


@pytest.mark.parametrize("option", ["--output", "--engine-runtime"])
def test_no_source_names_an_option_that_is_gone(option: str) -> None:
    folders = ("apps", "stages", "scene", "hw_profiles", "pipeline", "docs", "bench", "avatars", "training")
    files = [path for folder in folders for path in (ROOT / folder).rglob("*") if path.suffix in {".py", ".md", ".js"}]
    assert len(files) > 200
    named = {path.name for path in files if re.search(rf"{option}\b(?!-)", path.read_text())}
    assert named == {"old_names.py", "command-names.md"}
