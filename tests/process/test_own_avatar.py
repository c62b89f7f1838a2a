"""The walk of docs/own-avatar.md: each of its commands is run, one after the other, with fewer frames and steps."""

from __future__ import annotations

import re
import shlex
import subprocess
import sys
from pathlib import Path

import pytest

from trilane import machine
from trilane.avatars.bundle import load_bundle

PAGE = Path(__file__).parents[2] / "docs" / "own-avatar.md"
#: What is put in the place of a long option's value; and what is added to a command.
SHORTER = {
    "--frames 120": "--frames 6",
    "1920x1080": "320x240",
    "--minutes 600": "--steps 10 --samples 8",
}
ADDED = {"run": "--frames 2 --size 64", "quantise": "--count 2"}


def commands() -> list[list[str]]:
    """The words of every command of the page, shortened."""
    block = re.search(r"```bash\n(.*?)```", PAGE.read_text(), re.DOTALL)
    assert block is not None
    lines = block[1].splitlines()
    for long, short in SHORTER.items():
        assert long in block[1]
        lines = [line.replace(long, short) for line in lines]
    words = [shlex.split(line) for line in lines]
    return [each + shlex.split(next((more for name, more in ADDED.items() if name in each[1:3]), "")) for each in words]


def test_the_page_names_the_whole_way() -> None:
    names = [words[2] if words[1] == "avatar" else words[1] for words in commands()]
    walk = ["create-data", "check-data", "train", "run", "inspect", "quantise", "create", "run", "export"]
    assert names == walk and all(words[0] == "trilane" for words in commands())


@pytest.mark.slow
@pytest.mark.timeout(900)
@pytest.mark.skipif(
    not machine.here.has_package("torch") or not machine.here.has_package("skimage"), reason="training needs PyTorch"
)
def test_every_command_of_the_walk_does_what_the_page_says(tmp_path: Path) -> None:
    for words in commands():
        if "--qnn" in words and not machine.here.has_package("onnxruntime_qnn"):
            continue
        line = [sys.executable, "-m", "trilane.apps.cli.main", *words[1:]]
        done = subprocess.run(line, cwd=tmp_path, capture_output=True, text=True, check=False, timeout=600)
        assert done.returncode == 0, f"{shlex.join(words)}\nended with {done.returncode}: {done.stderr}"
    own, made = load_bundle(tmp_path / "mine"), load_bundle(tmp_path / "mine-entropy")
    assert own.manifest.provenance["held_out_error"]["frames"] >= 1 and "seen" in own.manifest.provenance["texels"]
    assert made.manifest.provenance["replaced"] == {"network": "entropy.onnx"}
    assert made.read_network().digest != own.read_network().digest
    assert (made.manifest.network.encoder, made.manifest.network.width) == ("resnet18", 16)
