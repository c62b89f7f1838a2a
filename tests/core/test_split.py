"""A network in two parts: at every place where it can be cut, the parts give the bytes of the whole."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import onnxruntime
import pytest
from typer.testing import CliRunner

from trilane.apps.cli.avatar import app
from trilane.avatars.bundle import load_bundle
from trilane.avatars.network_file import NetworkFile
from trilane.avatars.network_split import cuts, split
from trilane.errors import BadInputError

QUIET = 3


def run(model: onnx.ModelProto, known: dict[str, Any]) -> dict[str, Any]:
    """`known` and what `model` makes of it."""
    settings = onnxruntime.SessionOptions()
    settings.log_severity_level = QUIET
    session = onnxruntime.InferenceSession(model.SerializeToString(), settings, providers=["CPUExecutionProvider"])
    values = session.run(None, {value.name: known[value.name] for value in session.get_inputs()})
    return known | dict(zip([value.name for value in session.get_outputs()], values, strict=True))


@pytest.fixture(scope="module")
def network(tiny_quantised: Any) -> NetworkFile:
    return tiny_quantised.network


def test_parts_give_the_bytes_of_the_whole_wherever_it_is_cut(network: NetworkFile) -> None:
    tensor = np.random.default_rng(0).integers(0, 256, network.shape, dtype=np.uint8)
    inputs = {network.model.graph.input[0].name: tensor}
    output = network.model.graph.output[0].name
    whole = run(network.model, inputs)[output]
    places = list(cuts(network))
    assert len(places) >= 3
    for cut in places:
        head, tail = (part.model for part in split(network, [cut.at]))
        kinds = {value.type.tensor_type.elem_type for value in (*head.graph.output, *tail.graph.input)}
        assert kinds == {onnx.TensorProto.UINT8}
        assert (run(tail, run(head, inputs))[output] == whole).all()
        assert cut.bytes == sum(np.prod(shape) for shape in cut.crossing.values())


def test_the_default_avatar_can_be_cut_at_its_skips() -> None:
    places = list(cuts(load_bundle("default").read_network()))
    assert len(places) > 40
    assert max(len(cut.crossing) for cut in places) >= 6


def test_a_tensor_that_is_not_quantised_is_no_place_to_cut(network: NetworkFile) -> None:
    with pytest.raises(BadInputError, match="'nowhere', expected a quantised tensor"):
        split(network, ["nowhere"])


def test_the_command_lists_places_and_writes_parts(tmp_path: Path, tiny_bundle: Path) -> None:
    listed = CliRunner().invoke(app, ["split", str(tiny_bundle), "--size", "64", "--json"])
    places = [row["at"] for row in json.loads(listed.stdout)["cuts"]]
    written = CliRunner().invoke(
        app, ["split", str(tiny_bundle), "--size", "64", "--at", places[0], "--out", str(tmp_path / "parts"), "--json"]
    )
    assert written.exit_code == 0
    assert {path.name for path in (tmp_path / "parts").iterdir()} == {"part-1.onnx", "part-2.onnx"}


def test_half_of_the_options_is_refused(tiny_bundle: Path) -> None:
    with pytest.raises(BadInputError, match="--at without --out"):
        raise CliRunner().invoke(app, ["split", str(tiny_bundle), "--at", "x"]).exception or AssertionError


def test_many_parts_give_the_bytes_of_the_whole(network: NetworkFile) -> None:
    tensor = np.random.default_rng(1).integers(0, 256, network.shape, dtype=np.uint8)
    known = {network.model.graph.input[0].name: tensor}
    output = network.model.graph.output[0].name
    whole = run(network.model, known)[output]
    parts = split(network, [cut.at for cut in cuts(network)][::2])
    assert len(parts) > 3
    for part in parts:
        assert set(part.inputs) <= set(part.crossing_in) and set(part.outputs) <= set(part.crossing_out)
        assert set(part.crossing_out) - set(part.outputs) <= set(part.crossing_in)
        known = run(part.model, known)
    assert (known[output] == whole).all()


def test_an_uncut_network_is_one_part(network: NetworkFile) -> None:
    (part,) = split(network, [])
    assert part.crossing_in == {network.model.graph.input[0].name: network.shape}
    assert part.crossing_out == {network.model.graph.output[0].name: (*network.shape[:3], 4)}


def test_cuts_in_another_order_are_refused(network: NetworkFile) -> None:
    first, second, *_ = (cut.at for cut in cuts(network))
    with pytest.raises(BadInputError, match="in the order of the work"):
        split(network, [second, first])
