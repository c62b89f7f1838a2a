"""What the avatar's pipeline says of itself: stages, edges, assets, options; and what stages refuse, word for word."""

from __future__ import annotations

from dataclasses import fields, replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from support.small_pipeline import assets_of
from trilane.avatars.bundle import load_bundle
from trilane.avatars.network_split import cuts
from trilane.body.body import Body
from trilane.errors import BadInputError, MissingPartError
from trilane.pipeline.description import UnitSettings
from trilane.pipeline.memory import BYTES
from trilane.scene.schema import AvatarSpec, CameraSpec, OutputSpec, Scene
from trilane.scene.staging import stage_scene
from trilane.stages import avatar_assets, avatar_pipeline, configure
from trilane.stages.config import NetworkCut, RunConfig
from trilane.stages.cpu.present import PresentStage
from trilane.stages.dsp.infer import crossing_bytes
from trilane.stages.gpu.composite import CompositeStage
from trilane.stages.gpu.raster import RasterStage
from trilane.stages.run_options import RunOptions
from trilane.transport.packets import Packet
from trilane.units import NO_FIGURES


def configured(folder: Path, **values: Any) -> RunConfig:
    units = {name: UnitSettings(cores=(0,), threads=1) for name in ("cpu", "gpu", "dsp")}
    defaults: dict[str, Any] = {
        "scene": Scene(size="64", output=OutputSpec(width=100, height=64), fps=12.5, frames=9),
        "out_dir": folder,
        "avatar_dirs": (folder,),
        "units": units,
    }
    return RunConfig(**(defaults | values))


# --- configuration and pipeline --------------------------------------------------------------------------------------


def test_edges_have_room_for_what_crosses_them(tiny_bundle: Path) -> None:
    """Bytes: 3 floats a vertex, 16 channels and 4 colours a tensor pixel, 3 a frame's pixel; the cuts' own."""
    network = load_bundle(tiny_bundle).read_network()
    assets = assets_of(configured(tiny_bundle))
    sizes = avatar_pipeline.edge_bytes(configured(tiny_bundle, posed_vertices=(10, 20)), assets)
    assert sizes == {
        "pose->raster": 30 * 12,
        "raster->infer": 4096 * 16,
        "infer->composite": 4096 * 4,
        "composite->present": 19200,
    }
    at = [cut.at for cut in cuts(network)][1:4:2]
    config = configured(tiny_bundle, cuts=tuple(NetworkCut(at=name, unit="gpu") for name in at))
    first, second = crossing_bytes(config, network)
    sizes = avatar_pipeline.edge_bytes(config, assets)
    assert list(sizes.items()) == [
        ("pose->raster", 0),
        ("raster->infer", 65536),
        ("infer->infer-2", first),
        ("infer-2->infer-3", second),
        ("infer-3->composite", 16384),
        ("composite->present", 19200),
    ]


@pytest.mark.parametrize(("asked", "run"), [(None, 9), (0, 0), (4, 4)])
def test_a_run_has_the_frames_that_are_asked_for(
    asked: int | None, run: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(avatar_pipeline, "avatar_pipeline", lambda *_: "pipeline")
    monkeypatch.setattr(avatar_pipeline, "run_pipeline", lambda _, frames, **__: frames)
    assert avatar_pipeline.run_avatar(configured(tmp_path), {}, frames=asked) == run


def test_the_shape_is_the_squarest_of_those_that_are_large() -> None:
    """Half of the most pixels is too small; of two as square the one with fewer rows."""

    def shape(*buckets: tuple[int, int], most: int = 20_000) -> tuple[int, int]:
        return avatar_pipeline.one_shape(SimpleNamespace(buckets=buckets, max_tensor_pixels=most))  # type: ignore[arg-type]

    assert shape((100, 100), (90, 140), (140, 90)) == (90, 140)
    assert shape((100, 100), (80, 240), (140, 90), most=19_999) == (100, 100)


# --- assets ----------------------------------------------------------------------------------------------------------


def test_what_is_packed_is_what_the_units_find(tiny_bundle: Path) -> None:
    """Two distinct avatars, the second with another texture and other input; one of them in the scene twice."""
    first = avatar_assets.load_avatar(load_bundle(tiny_bundle))
    manifest = first.bundle.manifest
    entry = manifest.network
    changed = entry.model_copy(update={"input": entry.input.model_copy(update={"scale": 0.125, "zero_point": 3})})
    bundle = replace(first.bundle, manifest=manifest.model_copy(update={"network": changed}))
    body = replace(first.shaped.body, posedirs=np.ones((len(first.shaped.vertices), 3, 486), np.float32))
    shaped = replace(first.shaped, vertices=first.shaped.vertices + 1, joints=first.shaped.joints + 2, body=body)
    second = replace(first, bundle=bundle, texture=first.texture + 1, shaped=shaped)
    scene = Scene(size="64", avatars=(AvatarSpec(), AvatarSpec()))
    staged = stage_scene(scene, [first.shaped, first.shaped], Path.cwd())
    assets = avatar_assets.pack_assets([first, second], staged)
    for number, avatar in enumerate((first, second)):
        found = avatar_assets.shaped_body(assets, number)
        assert np.array_equal(found.vertices, avatar.shaped.vertices)
        assert np.array_equal(found.joints, avatar.shaped.joints)
        for field in fields(Body):
            if field.name == "source":
                continue
            value, expected = getattr(found.body, field.name), getattr(avatar.shaped.body, field.name)
            if field.name == "hand_components":
                assert all(np.array_equal(a, b) for a, b in zip(value, expected, strict=True))
            elif expected is None:
                assert value is None
            else:
                assert np.array_equal(value, expected)
        assert found.body.source == f"avatar {number} of the run"
        assert np.array_equal(avatar_assets.texture_of(assets, number), avatar.texture)
    encoding = avatar_assets.quantisation_of(assets, 0)
    assert (encoding.scale, encoding.zero_point) == (entry.input.scale, entry.input.zero_point)
    encoding = avatar_assets.quantisation_of(assets, 1)
    assert (encoding.scale, encoding.zero_point) == (0.125, 3)
    found = avatar_assets.networks_of(assets)
    assert [(one.model, one.where) for one in found] == [(first.network.model, first.network.where)] * 2
    with pytest.raises(BadInputError, match="one of 2 networks in the scene"):
        avatar_assets.only_network_of(assets)
    with pytest.raises(BadInputError, match="one of 2 networks in the scene"):
        avatar_assets.with_network(assets, first.network)
    (alone,) = avatar_assets.networks_of(avatar_assets.pack_assets([first], staged))
    assert alone.model == first.network.model
    again = avatar_assets.staged_of(assets)
    assert np.array_equal(again.camera.sample(0.3), staged.camera.sample(0.3))
    assert len(again.movers) == 2
    config = configured(tiny_bundle, avatar_dirs=(Path("/b"), Path("/a"), Path("/b")))
    assert avatar_assets.distinct(config) == [Path("/b"), Path("/a")]
    other = replace(first.network, where="x", model=type(first.network.model)())
    brighter = replace(first, texture=first.texture * 2)
    unlike = [first, second, replace(first, network=other), brighter, second]
    assert avatar_assets.networks_of_avatars(unlike) == [0, 1, 2, 0, 1]


# --- options ---------------------------------------------------------------------------------------------------------


def test_rate_and_picture_are_laid_over_the_scene() -> None:
    scene = configure.requested_scene(RunOptions(scene="walk-past", fps=24.0, picture="320x482"))
    assert (scene.name, scene.fps, scene.output.width, scene.output.height) == ("walk-past", 24.0, 320, 482)
    for picture, sentence in (
        ("320", "--picture: found '320', expected WIDTHxHEIGHT in pixels, such as 640x480"),
        ("-2x64", "--picture: found '-2x64', expected WIDTHxHEIGHT in pixels, such as 640x480"),
        ("62x64", "command line: output.width: found 62, expected a multiple of 2 from 64 to 4096"),
        ("64x67", "command line: output.height: found 67, expected a multiple of 2 from 64 to 4096"),
    ):
        with pytest.raises(BadInputError) as raised:
            configure.requested_scene(RunOptions(picture=picture))
        assert str(raised.value) == sentence


def test_a_camera_of_the_command_line_drops_what_the_scene_says_of_its_own_file(tmp_path: Path) -> None:
    """All of it where a built-in one has no file; another file keeps all but the format."""
    scene = tmp_path / "mine.toml"
    scene.write_text("[camera]\nsource = 'a.txt'\nformat = 'tum'\nup_axis = 'z'\nrate_hz = 10\nfov_y_deg = 50\n")
    built_in = configure.requested_scene(RunOptions(scene=str(scene), camera="builtin:far")).camera
    assert built_in == CameraSpec(source="builtin:far", fov_y_deg=50.0)
    other = configure.requested_scene(RunOptions(scene=str(scene), camera=str(tmp_path / "b.txt"))).camera
    assert (other.format, other.up_axis, other.rate_hz) == ("auto", "z", 10.0)


def test_an_edge_is_one_of_the_rules() -> None:
    for edge in ("single", "double", "triple", "fifo", "fifo:1", "fifo:64", "orphan", "orphan:4"):
        assert RunOptions(edge=edge).edge == edge
    kinds = "single, double, triple, fifo:N or orphan:N"
    for edge, sentence in (
        ("doubel", f"expected {kinds}; did you mean 'double'?"),
        ("fifi:3", f"expected {kinds}; did you mean 'fifo'?"),
        ("double:3", f"expected {kinds}"),
        ("", f"expected {kinds}"),
        ("orphan:3", "expected orphan:N with N from 4 to 64"),
        ("fifo:65", "expected fifo:N with N from 1 to 64"),
    ):
        with pytest.raises(BadInputError) as raised:
            RunOptions.checked({"edge": edge}, as_typed=True)
        assert str(raised.value) == f"--edge: found {edge!r}, {sentence}"


def test_cuts_are_a_tensor_and_a_unit(tiny_bundle: Path) -> None:
    network = load_bundle(tiny_bundle).read_network()
    first, second = [cut.at for cut in cuts(network)][:2]
    assert configure.requested_cuts((f"{first}=gpu", f"{second}=cpu"), [network]) == (
        NetworkCut(at=first, unit="gpu"),
        NetworkCut(at=second, unit="cpu"),
    )
    assert configure.requested_cuts((), [network, network]) == ()
    for text in (f"{first}=npu", first, "=gpu="):
        with pytest.raises(BadInputError, match="TENSOR=UNIT, with UNIT one of cpu, gpu, dsp"):
            configure.requested_cuts((text,), [network])
    with pytest.raises(BadInputError, match="quantised tensor"):
        configure.requested_cuts(("nowhere=gpu",), [network])
    with pytest.raises(BadInputError, match="2 networks in the scene"):
        configure.requested_cuts((f"{first}=gpu",), [network, network])


@pytest.mark.parametrize(
    ("asked", "driver", "unit"),
    [
        ("cpu", {"hardware": True}, ("cpu", "as asked")),
        ("gpu", {"hardware": False}, ("gpu", "as asked")),
        ("auto", {"hardware": True}, ("gpu", "the driver is hardware")),
        ("auto", {"hardware": False}, ("cpu", "the OpenGL driver is software")),
        ("auto", {}, ("cpu", "the OpenGL driver is software")),
        ("auto", None, ("cpu", "the OpenGL driver is software")),
    ],
)
def test_the_gpu_skins_where_it_is_one(asked: str, driver: Any, unit: tuple[str, str]) -> None:
    assert configure.skinning_unit(asked, lambda: driver) == unit


def test_a_machine_without_a_driver_is_refused() -> None:
    with pytest.raises(BadInputError, match=r"--skinning: found 'tpu', expected auto, cpu or gpu"):
        configure.skinning_unit("tpu", lambda: None)
    with pytest.raises(MissingPartError, match=r"no OpenGL 3.3 context through EGL"):
        configure.required_machine(lambda: None)
    assert configure.required_machine(lambda: {"vendor": "v"})["gl"] == {"vendor": "v"}


def test_a_request_becomes_a_checked_configuration(tiny_bundle: Path, tmp_path: Path) -> None:
    request = RunOptions(avatar=str(tiny_bundle), size="64", runtime="ort", frames=3)
    software = configure.configure(request, tmp_path, lambda: {"hardware": False})
    config = software.config
    vertices = len(avatar_assets.shaped_body(software.assets, 0).vertices)
    assert config.avatar_dirs == (tiny_bundle.absolute(),) and config.posed_vertices == (vertices,)
    assert (config.out_dir, config.runtime, config.cuts, config.scene.frames) == (tmp_path, "ort", (), 3)
    assert software.notes[-2:] == ("runtime: ort (as asked)", "skinning: cpu unit (the OpenGL driver is software)")
    why = f"it was never validated; `trilane avatar validate {tiny_bundle}` measures it"
    assert software.accuracy == {"tiny": {"source": NO_FIGURES, "changed": [], "why": why}}
    changed = software.changed(record=False, runtime="openvino")
    assert (changed.config.record, changed.config.runtime, config.record) == (False, "openvino", True)
    assert changed.assets is software.assets and changed.notes == software.notes
    assert configure.configure(request, tmp_path, lambda: {"hardware": True}).config.posed_vertices == ()


# --- facts -----------------------------------------------------------------------------------------------------------


def config(folder: Path, **changes: Any) -> RunConfig:
    return RunConfig(scene=Scene(), out_dir=folder, avatar_dirs=(), units={}, **changes)


def test_a_configuration_has_three_units(tmp_path: Path) -> None:
    settings = UnitSettings(cores=(0,), threads=1)
    with pytest.raises(ValueError, match=r"found unknown unit \['fpga', 'npu'\], expected cpu, gpu, dsp"):
        RunConfig(
            scene=Scene(), out_dir=tmp_path, avatar_dirs=(), units=dict.fromkeys(("npu", "cpu", "fpga"), settings)
        )


@pytest.mark.parametrize("slots", [(None, 0), (0, None), (None, None)])
@pytest.mark.parametrize(("stage", "name"), [(RasterStage, "raster"), (CompositeStage, "composite")])
def test_the_gpus_stages_need_two_slots(stage: Any, name: str, slots: tuple[Any, Any]) -> None:
    with pytest.raises(ValueError) as caught:
        object.__new__(stage).run(0, *slots)
    assert str(caught.value) == f"{name} needs an input and an output slot"


def test_the_present_stage_has_an_input_alone(tmp_path: Path) -> None:
    packet = Packet(np.zeros(1, "u8")[0], np.zeros(1 << 22, np.uint8))
    for record in (False, True):
        stage = PresentStage(config(tmp_path / "run", record=record))
        with pytest.raises(ValueError) as caught:
            stage.bind([packet], [packet])
        assert str(caught.value) == "the present stage has no output edge"
        assert not (tmp_path / "run").exists()
        with pytest.raises(ValueError) as caught:
            stage.run(0, None, None)
        assert str(caught.value) == "the present stage needs an input slot"


def test_without_a_recording_nothing_is_written_or_measured(tmp_path: Path) -> None:
    stage = PresentStage(config(tmp_path / "run", record=False))
    stage.bind([Packet(np.zeros(1, "u8")[0], np.zeros(1 << 22, np.uint8))], [])
    assert stage.run(0, 0, None) == dict.fromkeys(BYTES, 0)
    stage.close()
    assert not (tmp_path / "run").exists()
