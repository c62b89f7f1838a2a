"""Whose figures of accuracy are shown: an avatar's own, drawn as they were measured, and nobody else's."""

from __future__ import annotations

import errno
import hashlib
import json
import re
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import onnx
import pytest
from onnx import TensorProto
from typer.testing import CliRunner

from support.small_inputs import OTHER_PSNR_DB, PSNR_DB, validated
from trilane.apps.cli.avatar import app
from trilane.avatars.bundle import load_bundle, write_bundle, write_manifest
from trilane.avatars.manifest import digests_of, sha256_of, with_figures_digest
from trilane.avatars.validation import DrawnAs, accuracy_of, validation_facts
from trilane.errors import BadInputError
from trilane.stages.configure import configure
from trilane.stages.run_options import RunOptions
from trilane.units import NO_FIGURES


def _shuffle_texture(folder: Path) -> None:
    with np.load(folder / "texture.npz") as arrays:
        content = dict(arrays)
    texture = content["texture"]
    order = np.random.default_rng(0).permutation(texture.shape[0] * texture.shape[1])
    content["texture"] = texture.reshape(-1, texture.shape[2])[order].reshape(texture.shape)
    np.savez_compressed(folder / "texture.npz", **content)


def _exchange_network(folder: Path) -> None:
    """Other weights in one layer, with the scales and zero points of the ends as they were."""
    model = onnx.load(folder / "network.onnx")
    weights = max(
        (tensor for tensor in model.graph.initializer if tensor.data_type in (TensorProto.INT8, TensorProto.UINT8)),
        key=lambda tensor: len(tensor.raw_data),
    )
    weights.raw_data = weights.raw_data[::-1]
    onnx.save(model, folder / "network.onnx")


def _exchange_body(folder: Path) -> None:
    with np.load(folder / "body.npz") as arrays:
        content = dict(arrays)
    content["v_template"] = content["v_template"] * np.float32(1.05)
    np.savez_compressed(folder / "body.npz", **content)


def _change_constants(folder: Path) -> None:
    path = folder / "manifest.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | {"betas": [0.5]}))


#: Part, as `digests` has it, to what exchanges it in a folder.
SPOILT: dict[str, Callable[[Path], None]] = {
    "texture": _shuffle_texture,
    "network": _exchange_network,
    "body": _exchange_body,
    "constants": _change_constants,
}


def spoil(folder: Path, part: str) -> None:
    """Exchange `part` of the bundle in `folder`."""
    SPOILT[part](folder)


def numbers_in(text: str) -> list[str]:
    """Every decimal number in `text`, as it is written."""
    return re.findall(r"\d+\.\d+", text)


DRAWN = DrawnAs("ort", "256")
SOURCE = "from the avatar's validation of 2026-01-02"


@pytest.fixture
def own(tiny_bundle, tmp_path):
    """A bundle whose manifest has a validation of its files."""
    folder = shutil.copytree(tiny_bundle, tmp_path / "own")
    write_manifest(folder, validated(load_bundle(folder)))
    return folder


def test_an_avatars_own_figures_are_shown_with_their_source(own):
    facts = accuracy_of(load_bundle(own), DRAWN)
    figures = ["psnr_db_by_band", "psnr_db_by_background", "see_through", "iou", "ssim"]
    assert list(facts) == ["source", "runtime", "size", *figures]
    assert facts["source"] == SOURCE
    assert (facts["runtime"], facts["size"]) == ("ort", "256")
    assert facts["psnr_db_by_band"] == {"full_body": PSNR_DB}
    assert (facts["iou"], facts["ssim"]) == (0.9753, 0.8642)


def test_each_runtime_has_its_own_figures(own):
    facts = accuracy_of(load_bundle(own), replace(DRAWN, runtime="openvino"))
    assert facts["runtime"] == "openvino"
    assert facts["psnr_db_by_band"] == {"full_body": OTHER_PSNR_DB}
    assert str(PSNR_DB) not in json.dumps(facts)


@pytest.mark.parametrize("part", SPOILT)
def test_of_a_changed_part_no_figure_is_shown(own, part):
    spoil(own, part)
    bundle = load_bundle(own)
    for facts in (accuracy_of(bundle, DRAWN), validation_facts(bundle)):
        assert facts.keys() == {"source", "changed", "why"}
        assert facts["source"] == NO_FIGURES
        assert facts["changed"] == [part]
        assert f"trilane avatar validate {own}" in facts["why"]
        assert "2026-01-02" in facts["why"]


@pytest.mark.parametrize("part", SPOILT)
def test_inspect_shows_no_figure_of_a_changed_part(own, part):
    spoil(own, part)
    for options in ([], ["--json"]):
        result = CliRunner().invoke(app, ["inspect", str(own), *options])
        assert result.exit_code == 0
        assert "since the validation of 2026-01-02" in " ".join(result.stdout.split())
        assert not {"31.4159", "31.42", "27.18", "0.9753", "0.8642"} & set(numbers_in(result.stdout))


OTHERWISE = {
    "qnn": ({"runtime": "qnn"}, "validated on ort and openvino, and this is qnn"),
    "192": ({"size": "192"}, "validated at tensor size 256, and this is 192"),
    "256x256": ({"size": "256x256"}, "validated at tensor size 256, and this is 256x256"),
    "auto": ({"size": "auto"}, "at tensor size 256, and this is auto; `trilane bench planner` measures scenes whose"),
    "mipmap": ({"texture_filter": "mipmap"}, "with the linear texture filter, and this is mipmap"),
    "several": ({"avatars": 3}, "alone in its tensor, and here 3 avatars share one"),
}


@pytest.mark.parametrize("case", OTHERWISE)
def test_drawn_otherwise_than_validated_no_figure_is_shown(own, case):
    changes, why = OTHERWISE[case]
    facts = accuracy_of(load_bundle(own), replace(DRAWN, **changes))
    assert facts.keys() == {"source", "changed", "why"}
    assert facts["changed"] == []
    assert why in facts["why"]


def test_the_command_that_mends_measures_what_is_drawn(own):
    facts = accuracy_of(load_bundle(own), DrawnAs("qnn", "192"))
    assert facts["why"].endswith(
        f"`trilane avatar validate {own} --size 192 --runtime qnn` measures it, in place of what the manifest says now"
    )


def test_a_validation_without_digests_is_of_unknown_parts(own):
    """So wrote Trilane before it had digests: the manifest is read, its figures are not shown."""
    path = own / "manifest.json"
    manifest = json.loads(path.read_text())
    manifest["validation"] = {"psnr_db_by_band": {"face": 28.26}, "iou": 0.98, "ssim": 0.93, "float": {"psnr_db": 30.3}}
    path.write_text(json.dumps(manifest))
    facts = accuracy_of(load_bundle(own), DRAWN)
    assert facts["source"] == NO_FIGURES
    assert "no digests" in facts["why"] and "trilane avatar validate" in facts["why"]
    assert "28.26" not in json.dumps([facts, validation_facts(load_bundle(own))])


def test_figures_before_one_grey_are_not_shown(own):
    """So measured Trilane before it had backgrounds: a person who lets the grey through had no error."""
    bundle = load_bundle(own)
    validation = bundle.manifest.validation.model_copy(update={"psnr_db_by_background": None})
    write_manifest(own, bundle.manifest.model_copy(update={"validation": with_figures_digest(validation)}))
    facts = accuracy_of(load_bundle(own), DRAWN)
    assert facts["source"] == NO_FIGURES
    assert "before one grey" in facts["why"] and f"trilane avatar validate {own}" in facts["why"]


def test_a_byte_of_a_part_changes_its_digest_alone(own):
    before = digests_of(own, load_bundle(own).manifest).model_dump()
    for part, file in (("body", "body.npz"), ("texture", "texture.npz"), ("network", "network.onnx")):
        kept = (own / file).read_bytes()
        (own / file).write_bytes(kept[:-1] + bytes([kept[-1] ^ 1]) if part != "network" else kept + b"\x08\x0a")
        after = digests_of(own, load_bundle(own).manifest).model_dump()
        assert {key for key in before if after[key] != before[key]} == {part}
        (own / file).write_bytes(kept)
    assert digests_of(own, load_bundle(own).manifest).model_dump() == before


def test_tensors_beside_the_network_count_as_the_network(own):
    """Their files can change while the ONNX file stays the same to the byte."""
    manifest = load_bundle(own).manifest
    model = onnx.load(own / "network.onnx")
    onnx.save(model, own / "network.onnx", save_as_external_data=True, location="weights.bin", size_threshold=0)
    before = digests_of(own, manifest)
    data = bytearray((own / "weights.bin").read_bytes())
    data[0] ^= 1
    (own / "weights.bin").write_bytes(data)
    after = digests_of(own, manifest)
    assert after.network != before.network
    assert (after.body, after.texture, after.constants) == (before.body, before.texture, before.constants)


@pytest.mark.parametrize(
    ("changes", "counts"),
    [
        ({"betas": (0.5,)}, True),
        ({"expression": (0.5,)}, True),
        ({"name": "another"}, False),
        ({"training_command": "another"}, False),
        ({"provenance": {"seed": 2}}, False),
    ],
)
def test_constants_are_the_numbers_that_the_picture_depends_on(own, changes, counts):
    manifest = load_bundle(own).manifest
    changed = manifest.model_copy(update=changes)
    assert (digests_of(own, changed).constants != digests_of(own, manifest).constants) == counts


@pytest.mark.parametrize("end", ["input", "output"])
@pytest.mark.parametrize("change", [{"scale": 0.5}, {"zero_point": 7}])
def test_every_quantisation_constant_counts(own, end, change):
    manifest = load_bundle(own).manifest
    entry = manifest.network
    changed = entry.model_copy(update={end: getattr(entry, end).model_copy(update=change)})
    other = manifest.model_copy(update={"network": changed})
    assert digests_of(own, other).constants != digests_of(own, manifest).constants


def test_a_bundle_that_is_packed_again_keeps_its_own_validation_and_no_others(own, tiny_quantised, tmp_path):
    bundle = load_bundle(own)
    texture = np.load(own / "texture.npz")["texture"]
    again = tmp_path / "again"
    write_bundle(again, bundle.manifest, bundle.body_path, texture, tiny_quantised.network)
    assert load_bundle(again).manifest.validation == bundle.manifest.validation
    write_bundle(again, bundle.manifest, bundle.body_path, texture[::-1], tiny_quantised.network)
    assert load_bundle(again).manifest.validation is None


def test_a_run_of_a_spoilt_copy_beside_the_avatar_shows_only_the_avatars_source(own, tmp_path):
    """Both have the same name; what is said of one is not said of the other."""
    copy = shutil.copytree(own, tmp_path / "copy")
    spoil(copy, "texture")
    (tmp_path / "both.toml").write_text(f'[[avatars]]\nbundle = "{own}"\n[[avatars]]\nbundle = "{copy}"\n')
    checked = configure(RunOptions(scene=str(tmp_path / "both.toml"), runtime="ort"), tmp_path, gl=lambda: None)
    facts = {name.rpartition("/")[2]: facts for name, facts in checked.accuracy.items()}
    assert facts["copy"]["changed"] == ["texture"]
    assert facts["own"]["changed"] == [] and "share" in facts["own"]["why"]


def changed_by_hand(folder, **changes):
    path = folder / "manifest.json"
    manifest = json.loads(path.read_text())
    manifest["validation"].update(changes)
    path.write_text(json.dumps(manifest))


BY_HAND = {
    "a figure": {"iou": 0.9754},
    "a figure of another runtime": {"other_runtimes": {}},
    "the runtime": {"runtime": "qnn"},
    "a figure that was not there": {"body_psnr_db": 40.0},
    "a key that no run shows": {"psnr_loss_db": {"face": 0.1}},
}


@pytest.mark.parametrize("case", BY_HAND)
def test_figures_that_were_changed_by_hand_are_not_shown(own, case):
    changed_by_hand(own, **BY_HAND[case])
    bundle = load_bundle(own)
    for facts in (accuracy_of(bundle, DRAWN), validation_facts(bundle)):
        assert facts.keys() == {"source", "changed", "why"}
        assert facts["why"].startswith("the figures were changed since the validation of 2026-01-02; `trilane avatar")


@pytest.mark.parametrize("key", ["date", "figures_digest"])
def test_without_date_or_digest_of_the_figures_none_is_shown(own, key):
    changed_by_hand(own, **{key: None})
    facts = accuracy_of(load_bundle(own), DRAWN)
    assert facts["source"] == NO_FIGURES and "no date or no digest of its figures" in facts["why"]


def test_the_digest_of_figures_is_of_their_values_in_one_way_of_writing(own):
    """By hand: sorted keys, no spaces, every key but the digest itself; the order in the file does not matter."""
    path = own / "manifest.json"
    said = json.loads(path.read_text())["validation"]
    found = said.pop("figures_digest")
    written = json.dumps(said, sort_keys=True, separators=(",", ":"))
    assert found == hashlib.sha256(written.encode()).hexdigest()
    manifest = json.loads(path.read_text())
    manifest["validation"] = dict(reversed(manifest["validation"].items()))
    path.write_text(json.dumps(manifest))
    assert accuracy_of(load_bundle(own), DRAWN)["source"] == SOURCE


WORST = {"seed": 1, "number": 2, "band": "face", "psnr_db": 20.0, "body_psnr_db": 19.0}
MALFORMED = {
    "no day": ({"date": ""}, "date"),
    "a day that is not": ({"date": "2999-99-99"}, "date"),
    "seconds since 1970": ({"date": 1763769600}, "date"),
    "a word": ({"body_psnr_db": "much"}, "body_psnr_db"),
    "another worst": ({"worst": {"x": 1}}, "worst"),
    "worst of unknown views": ({"worst": WORST}, "needs 'by_seed' and 'samples'"),
    "a seed": ({"by_seed": {"1": 20.0}}, "by_seed"),
    "no views": ({"samples": 0}, "samples"),
    "another runtime's": ({"other_runtimes": {"qnn": {"iou": 0.9, "ssim": 0.9, "psnr_db_by_band": 3}}}, "qnn"),
}


@pytest.mark.parametrize("case", MALFORMED)
def test_a_malformed_figure_is_found_when_the_manifest_is_read(own, case):
    changes, where = MALFORMED[case]
    changed_by_hand(own, **changes)
    with pytest.raises(BadInputError, match=rf"manifest\.json: validation.*{where}"):
        load_bundle(own)


def test_a_linked_manifest_is_written_where_it_leads(own, tmp_path):
    kept = (own / "manifest.json").rename(tmp_path / "kept.json")
    (own / "manifest.json").symlink_to(kept)
    write_manifest(own, load_bundle(own).manifest.model_copy(update={"name": "renamed"}))
    assert (own / "manifest.json").is_symlink()
    assert json.loads(kept.read_text())["name"] == "renamed"


def test_a_manifest_that_cannot_be_written_ends_the_validation_before_its_work(own, monkeypatch):
    pytest.importorskip("skimage")

    def refuse(*_args, **_options):
        raise OSError(errno.EROFS, "Read-only file system")

    monkeypatch.setattr("trilane.writing.tempfile.TemporaryFile", refuse)
    monkeypatch.setattr("trilane.training.validate.open_renderer", lambda *_: pytest.fail("the work began"))
    with pytest.raises(BadInputError, match=r"manifest\.json: found read-only file system"):
        CliRunner().invoke(app, ["validate", str(own)], catch_exceptions=False)


def test_a_part_that_cannot_be_read_is_named(tmp_path):
    (tmp_path / "texture.npz").mkdir()
    with pytest.raises(BadInputError) as caught:
        sha256_of([tmp_path / "texture.npz"])
    assert str(caught.value) == f"{tmp_path / 'texture.npz'}: found is a directory, expected a readable file"
