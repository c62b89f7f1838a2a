"""`auto`: the fastest runtime that is installed, by the host profile."""

from __future__ import annotations

import pytest

from trilane import machine
from trilane.errors import MissingPartError
from trilane.hw_profiles.host import fastest_runtime
from trilane.hw_profiles.profile_files import load_profile
from trilane.stages.dsp import runtime


@pytest.mark.parametrize(("flag", "fastest"), [("avx2", "openvino"), ("avx512_vnni", "openvino"), ("asimddp", "ort")])
def test_the_instructions_of_the_machine_decide(monkeypatch, flag, fastest):
    monkeypatch.setattr(machine.here, "cpu_flags", lambda: frozenset({"fpu", flag}))
    name, why = fastest_runtime(load_profile("host"), ["ort", "openvino", "qnn"])
    assert name == fastest and "host profile" in why and why.endswith("; installed, but of unknown speed: qnn")


def test_only_what_is_installed_is_taken():
    name, why = fastest_runtime(load_profile("host"), ["ort"])
    assert name == "ort" and "unknown" not in why


def test_nothing_to_take_says_what_to_install():
    with pytest.raises(MissingPartError, match="pip install onnxruntime"):
        fastest_runtime(load_profile("host"), ["qnn"])


@pytest.mark.parametrize(
    ("name", "architecture", "device"),
    [
        ("cuda", "x86_64", True),
        ("cuda", "aarch64", True),
        ("qnn", "x86_64", False),
        ("qnn", "aarch64", True),
        ("ort", "aarch64", False),
        ("openvino", "x86_64", False),
    ],
)
def test_which_runtimes_have_hardware_of_their_own(monkeypatch, name, architecture, device):
    monkeypatch.setattr(machine.here, "architecture", lambda: architecture)
    assert runtime.has_device(name) is device
