"""`trilane avatar network`, `split`, `export`, `inspect`: what they ask of the parts that work, and what they print."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import onnx
import pytest

from trilane.apps.avatar.assembled_avatar import bundle_facts
from trilane.apps.cli import avatar_network
from trilane.avatars import network_split
from trilane.avatars.bundle import load_bundle
from trilane.avatars.network_file import reshaped
from trilane.avatars.network_split import Cut
from trilane.body.body import load_body
from trilane.hw_profiles.network_work import graph_facts
from trilane.stages.dsp import runtime

Command = Callable[..., tuple[str, str]]


def module(name: str, **names: Any) -> ModuleType:
    made = ModuleType(name)
    made.__dict__.update(names)
    return made


def test_inspect_names_the_offsets_of_an_avatar_that_has_some() -> None:
    bundle = load_bundle("hiker")
    assert bundle.offsets_path is not None
    size = bundle.offsets_path.stat().st_size
    assert bundle_facts(bundle)["files"]["offsets"] == {"name": "offsets.npz", "bytes": size}


def test_inspect_says_what_the_files_hold(tiny_bundle: Path, command: Command) -> None:
    bundle = load_bundle(tiny_bundle)
    network = bundle.read_network()
    facts = bundle_facts(bundle)
    assert facts == {
        "name": "tiny",
        "folder": str(tiny_bundle),
        "files": {
            key: {"name": name, "bytes": (tiny_bundle / name).stat().st_size}
            for key, name in (("body", "body.npz"), ("texture", "texture.npz"), ("network", "network.onnx"))
        },
        "body": {"vertices": len(load_body(tiny_bundle / "body.npz").v_template)},
        "texture": {"shape": [32, 32, 5]},
        "network": {
            **bundle.manifest.network.model_dump(),
            "shape": [1, 64, 64, 5],
            "sha256": network.digest,
            **graph_facts(network.model),
        },
        "quantisation": bundle.manifest.quantisation,
        "provenance": bundle.manifest.provenance,
        "training_command": bundle.manifest.training_command,
        "validation": None,
    }
    assert json.loads(command("avatar", "inspect", tiny_bundle, "--json")[0]) == json.loads(json.dumps(facts))
    assert "network.shape [1, 64, 64, 5]" in " ".join(command("avatar", "inspect", tiny_bundle)[0].split())


class Untrained:
    """In place of PyTorch and what is trained with it."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.asked: list[Any] = []
        self.model = onnx.ModelProto(ir_version=8)
        torch = module("torch", manual_seed=lambda seed: self.asked.append(("seed", seed)))
        monkeypatch.setitem(sys.modules, "torch", torch)
        network = module("network", UNet=self._unet, export_onnx=self._export)
        monkeypatch.setitem(sys.modules, "trilane.training.network", network)
        monkeypatch.setattr("trilane.hw_profiles.network_work.graph_facts", lambda model: {"gmac": 1.5, "of": model})

    def _unet(self, *arguments: Any) -> Any:
        self.asked.append(arguments)
        return SimpleNamespace(parameters=lambda: [SimpleNamespace(numel=lambda: 40), SimpleNamespace(numel=lambda: 2)])

    def _export(self, unet: Any, *shape: int) -> onnx.ModelProto:
        assert unet.parameters
        self.asked.append(shape)
        return self.model


def test_a_network_is_asked_for_as_the_options_say(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, command: Command
) -> None:
    double, out = Untrained(monkeypatch), tmp_path / "n.onnx"
    printed = json.loads(command("avatar", "network", "--out", out, "--json")[0])
    assert double.asked == [("seed", 0), ("resnet18", "batch", 64, 16), (512, 512)]
    usual = {"encoder": "resnet18", "norm": "batch", "width": 64, "channels": 16, "size": [512, 512]}
    assert printed == {"file": str(out), **usual, "parameters": 42, "gmac": 1.5}
    assert out.read_bytes() == double.model.SerializeToString()
    double.asked.clear()
    words = ("--encoder", "mobilenetv3", "--norm", "group", "--width", 8, "--channels", 4, "--seed", 5)
    assert "parameters 42" in " ".join(command("avatar", "network", "--out", out, *words, "--size", "64x32")[0].split())
    assert double.asked == [("seed", 5), ("mobilenetv3", "group", 8, 4), (64, 32)]
    double.asked.clear()
    command("avatar", "network", "--out", out, "--size", "96")
    assert double.asked[-1] == (96, 96)


def test_a_network_without_pytorch_or_of_a_wrong_size(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, command: Command
) -> None:
    monkeypatch.setitem(sys.modules, "torch", None)
    _, err = command("avatar", "network", "--out", tmp_path / "n.onnx", code=3)
    assert err.startswith("error: exporting a network needs PyTorch; install it with: ") and "[train]" in err
    _, err = command("avatar", "network", "--out", tmp_path / "n.onnx", "--size", "65x64", code=2)
    assert err.startswith("error: --size: found ") and "multiple of 32" in err
    _, err = command("avatar", "split", tmp_path, "--size", "wide", code=2)
    assert err.startswith("error: --size: found 'wide")
    assert list(tmp_path.iterdir()) == []


def test_cuts_are_listed(
    monkeypatch: pytest.MonkeyPatch, tiny_bundle: Path, command: Command, check_printed: Callable[..., None]
) -> None:
    asked = []

    def cuts(network: Any) -> list[Cut]:
        asked.append(network.shape)
        return [Cut("first_q", {"first_q": (1, 2, 3)}, 4), Cut("second_q", {"a": (5,), "second_q": (7, 2)}, 9)]

    monkeypatch.setattr(network_split, "cuts", cuts)
    check_printed("avatar-split", command("avatar", "split", tiny_bundle)[0])
    rows = [{"at": "first_q", "tensors": 1, "bytes": 6}, {"at": "second_q", "tensors": 2, "bytes": 19}]
    assert json.loads(command("avatar", "split", tiny_bundle, "--size", "128x64", "--json")[0]) == {"cuts": rows}
    assert asked == [(1, 256, 256, 5), (1, 128, 64, 5)]


def test_parts_are_written_in_their_order(tiny_bundle: Path, tmp_path: Path, command: Command) -> None:
    whole = reshaped(load_bundle(tiny_bundle).read_network(), 64, 32)
    first, second = [cut.at for cut in network_split.cuts(whole)][:2]
    for place in ("new/parts", "new/parts", "more"):
        folder = tmp_path / place
        words = ("--at", first, "--at", second, "--out", folder, "--size", "64x32", "--json")
        printed = json.loads(command("avatar", "split", tiny_bundle, *words)[0])
        files = [folder / f"part-{number}.onnx" for number in (1, 2, 3)]
        assert printed == {"parts": [str(file) for file in files], "at": [first, second]}
        parts = [part.model.SerializeToString() for part in network_split.split(whole, [first, second])]
        assert [file.read_bytes() for file in files] == parts
    (tmp_path / "file").touch()
    _, err = command("avatar", "split", tiny_bundle, "--at", first, "--out", tmp_path / "file", code=2)
    assert err == f"error: {tmp_path}/file: found file exists, expected a folder that can be written\n"


def test_a_cut_and_a_folder_go_together(tiny_bundle: Path, tmp_path: Path, command: Command) -> None:
    _, err = command("avatar", "split", tiny_bundle, "--at", "x", code=2)
    assert err == "error: options: found --at without --out, expected both, or neither\n"
    _, err = command("avatar", "split", tiny_bundle, "--out", tmp_path / "parts", code=2)
    assert err == "error: options: found --out without --at, expected both, or neither\n"
    assert list(tmp_path.iterdir()) == []


def test_a_network_is_compiled_for_a_chip(
    monkeypatch: pytest.MonkeyPatch, tiny_bundle: Path, tmp_path: Path, command: Command
) -> None:
    asked: list[Any] = []

    def write_context(network: Any, soc: str, out: Path) -> None:
        asked.append((network.shape, soc))
        out.write_bytes(b"context")

    qnn = module("qnn", version=lambda: "QNN 2", write_context=write_context)
    monkeypatch.setitem(sys.modules, "trilane.stages.dsp.qnn", qnn)
    monkeypatch.setattr(runtime, "resolve", asked.append)
    out = tmp_path / "c.onnx"
    printed = json.loads(command("avatar", "export", tiny_bundle, "--qnn", "--out", out, "--json")[0])
    assert printed == {"file": str(out), "bytes": 7, "soc": "sm8350", "compiler": "QNN 2"}
    command("avatar", "export", tiny_bundle, "--qnn", "--out", out, "--soc", "sm8550", "--size", "64x128")
    assert asked == ["qnn", ((1, 64, 64, 5), "sm8350"), "qnn", ((1, 64, 128, 5), "sm8550")]
    asked.clear()
    assert command("avatar", "export", tiny_bundle, "--out", out, code=2) == (
        "",
        "error: avatar export: found no format, expected --qnn\n",
    )
    assert asked == []


def test_one_side_is_both() -> None:
    assert [avatar_network._both_sides(size) for size in ("64", "64x32")] == ["64x64", "64x32"]
