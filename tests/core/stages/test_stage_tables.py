"""What the avatar's pipeline says of itself: stages, edges, assets, options; and what stages refuse, word for word."""

from __future__ import annotations

import shutil
import subprocess
from dataclasses import fields, replace
from importlib import import_module
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from pydantic import ValidationError

from support.small_pipeline import assets_of
from trilane import machine
from trilane.avatars.bundle import load_bundle
from trilane.avatars.network_split import cuts
from trilane.avatars.validation import DrawnAs
from trilane.body.body import Body
from trilane.errors import BadInputError, MissingPartError
from trilane.figure_sources import NO_FIGURES
from trilane.pipeline.description import UnitSettings
from trilane.pipeline.memory import BYTES
from trilane.scene.schema import AvatarSpec, OutputSpec, Scene
from trilane.scene.staging import stage_scene
from trilane.stages import FACTORIES, PRELOAD, avatar_assets, avatar_pipeline, configure, machine_facts
from trilane.stages.config import AVATAR_DTYPE, NetworkCut, RunConfig, pose_dtype
from trilane.stages.cpu.present import PresentStage
from trilane.stages.dsp.infer import crossing_bytes
from trilane.stages.dsp.runtime import RuntimeOptions
from trilane.stages.gpu.composite import CompositeStage
from trilane.stages.gpu.raster import RasterStage
from trilane.stages.run_options import RunOptions
from trilane.transport.packets import Packet


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


def test_a_configuration_names_the_parts_of_its_network(tmp_path: Path) -> None:
    plain = configured(tmp_path)
    assert (plain.infer_units, plain.infer_names) == (("dsp",), ("infer",))
    assert (plain.runtime, plain.record, plain.posed_vertices, plain.pace_ns, plain.cuts) == ("ort", True, (), {}, ())
    made = configured(tmp_path, cuts=(NetworkCut(at="a", unit="gpu"), NetworkCut(at="b", unit="cpu")))
    assert (made.infer_units, made.infer_names) == (("dsp", "gpu", "cpu"), ("infer", "infer-2", "infer-3"))
    assert plain.buckets == [(32, 128), (64, 64), (128, 32)]
    assert plain.max_tensor_pixels == 4096
    assert configured(tmp_path, scene=Scene(size="96x32")).max_tensor_pixels == 3072
    with pytest.raises(ValidationError, match=r"unknown unit \['npu'\]"):
        configured(tmp_path, units=dict.fromkeys(("cpu", "npu"), UnitSettings(cores=(0,), threads=1)))


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


def test_the_pipeline_is_the_stages_in_their_order(tiny_bundle: Path) -> None:
    network = load_bundle(tiny_bundle).read_network()
    at = next(iter(cuts(network))).at
    config = configured(
        tiny_bundle,
        cuts=(NetworkCut(at=at, unit="gpu"),),
        avatar_dirs=(tiny_bundle, tiny_bundle),
        pace_ns={"raster": 5, "infer-2": 7},
    )
    made = avatar_pipeline.avatar_pipeline(config, assets_of(configured(tiny_bundle)), "triple")
    said = config.model_dump(mode="json")
    rows = [(stage.name, stage.unit, stage.factory, stage.settings, stage.pace_ns) for stage in made.stages]
    assert rows == [
        ("pose", "cpu", FACTORIES["pose"], {"config": said}, 0),
        ("raster", "gpu", FACTORIES["raster"], {"config": said}, 5),
        ("infer", "dsp", FACTORIES["infer"], {"config": said, "part": 0}, 0),
        ("infer-2", "gpu", FACTORIES["infer"], {"config": said, "part": 1}, 7),
        ("composite", "gpu", FACTORIES["composite"], {"config": said}, 0),
        ("present", "cpu", FACTORIES["present"], {"config": said}, 0),
    ]
    assert len(made.edges) == 5
    assert all(edge.header == pose_dtype(2) for edge in made.edges)
    assert made.latency_to == "composite" and made.preload == PRELOAD and made.units == config.units
    plain = avatar_pipeline.avatar_pipeline(configured(tiny_bundle), assets_of(configured(tiny_bundle)))
    assert plain.edges == plain.with_rule("double").edges != made.edges


@pytest.mark.parametrize(("asked", "frames"), [(None, 9), (4, 4)])
def test_a_run_has_the_scenes_frames_unless_told(tiny_bundle: Path, monkeypatch: Any, asked: Any, frames: int) -> None:
    given: dict[str, Any] = {}
    monkeypatch.setattr(avatar_pipeline, "run_pipeline", lambda *a, **k: given.update(args=a, **k) or "result")
    config, assets = configured(tiny_bundle), assets_of(configured(tiny_bundle))
    assert avatar_pipeline.run_avatar(config, assets, edge="triple", frames=asked, extra=5) == "result"
    pipeline, count = given["args"]
    assert (count, given["fps"], given["assets"] is assets, given["extra"]) == (frames, 12.5, True, 5)
    assert pipeline == avatar_pipeline.avatar_pipeline(config, assets, "triple")


def test_factories_are_functions_that_exist() -> None:
    assert list(FACTORIES) == ["pose", "raster", "infer", "composite", "present"]
    for stage, factory in FACTORIES.items():
        module, _, name = factory.partition(":")
        assert module.rpartition(".")[2] == stage
        assert callable(getattr(import_module(module), name))
    assert tuple(factory.removesuffix(":build") for factory in FACTORIES.values()) == PRELOAD


def test_a_packets_fields_and_their_bytes() -> None:
    kinds = {name: AVATAR_DTYPE.fields[name][0] for name in AVATAR_DTYPE.names}  # type: ignore[index,union-attr]
    assert kinds == {
        "avatar": np.dtype("<i4"),
        "visible": np.dtype("<i4"),
        "rect": np.dtype(("<f4", 4)),
        "tensor_rect": np.dtype(("<i4", 4)),
        "joints": np.dtype(("<f4", (55, 3, 4))),
        "pose_feature": np.dtype(("<f4", 486)),
    }
    packet = pose_dtype(3)
    assert packet["avatars"].shape == (3,) and packet["avatars"].base == AVATAR_DTYPE
    assert (packet["view"].shape, packet["projection"].shape, packet["tensor_shape"].shape) == ((4, 4), (4, 4), (2,))
    assert (packet["media_time_s"], packet["avatar_count"]) == (np.dtype("<f8"), np.dtype("<i4"))
    assert packet["view"].base == packet["projection"].base == np.dtype("<f4")
    assert packet["tensor_shape"].base == np.dtype("<i4")


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
    network = avatar_assets.network_of(assets)
    assert network.model == first.network.model and network.where == first.network.where
    again = avatar_assets.staged_of(assets)
    assert np.array_equal(again.camera.sample(0.3), staged.camera.sample(0.3))
    assert len(again.movers) == 2
    config = configured(tiny_bundle, avatar_dirs=(Path("/b"), Path("/a"), Path("/b")))
    assert avatar_assets.distinct(config) == [Path("/b"), Path("/a")]
    with pytest.raises(BadInputError, match=r"networks with different inputs"):
        avatar_assets.require_one_tensor([first, second])
    with pytest.raises(BadInputError, match=r"networks with different inputs"):
        avatar_assets.require_one_tensor([first, replace(first, texture=first.texture[..., :4])])
    other = replace(first.network, where="x", model=type(first.network.model)())
    with pytest.raises(BadInputError, match="another network"):
        avatar_assets.require_one_tensor([first, first, replace(first, network=other)])
    avatar_assets.require_one_tensor([first, replace(first, texture=first.texture * 2)])


# --- options ---------------------------------------------------------------------------------------------------------


def test_rate_and_output_are_laid_over_the_scene() -> None:
    scene = configure.requested_scene(RunOptions(scene="walk-past", fps=24.0, output="320x482"))
    assert (scene.name, scene.fps, scene.output.width, scene.output.height) == ("walk-past", 24.0, 320, 482)
    for output, sentence in (
        ("320", "--output: found '320', expected WIDTHxHEIGHT in pixels, such as 640x480"),
        ("-2x64", "--output: found '-2x64', expected WIDTHxHEIGHT in pixels, such as 640x480"),
        ("62x64", "command line: output.width: found 62, expected a multiple of 2 from 64 to 4096"),
        ("64x67", "command line: output.height: found 67, expected a multiple of 2 from 64 to 4096"),
    ):
        with pytest.raises(BadInputError) as raised:
            configure.requested_scene(RunOptions(output=output))
        assert str(raised.value) == sentence


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


def test_options_are_laid_over_the_scene(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, tiny_bundle: Path) -> None:
    values = {
        "frames": 20,
        "hud": True,
        "camera": {"source": "builtin:static", "format": "colmap", "fov_deg": 33.0},
        "avatars": [
            {"motion": "builtin:idle", "up_axis": "z", "units": "cm", "position": (1, 0, 0)},
            {"motion": "builtin:wave"},
        ],
    }
    asked = []
    monkeypatch.setattr(configure, "find_scene", lambda name: asked.append(name) or name)
    monkeypatch.setattr(configure, "load_scene", lambda _path: {**values, "avatars": list(values["avatars"])})
    seen: dict[str, Any] = {}
    monkeypatch.setattr(configure, "scene_from", lambda where, given: seen.update(where=where, **given) or "scene")
    monkeypatch.setattr(configure, "located", lambda text, here: f"{here.name}/{text}")
    monkeypatch.chdir(tmp_path)
    assert configure.requested_scene(RunOptions()) == "scene"
    assert asked == ["default"]
    assert seen == {"where": "command line"} | values
    seen.clear()
    request = RunOptions(
        scene="mine",
        motion="m.bvh",
        camera="c.json",
        background="b.png",
        avatar=str(tiny_bundle),
        frames=5,
        size="128",
        hud=False,
        runtime="ort",
    )
    configure.requested_scene(request)
    here = tmp_path.name
    assert (seen["frames"], seen["size"], seen["hud"], asked[-1]) == (5, "128", False, "mine")
    assert seen["background"] == f"{here}/b.png"
    assert seen["camera"] == {"source": f"{here}/c.json", "format": "auto", "fov_deg": 33.0}
    first, second = seen["avatars"]
    assert first == {
        "motion": f"{here}/m.bvh",
        "up_axis": "auto",
        "units": "auto",
        "position": (1, 0, 0),
        "bundle": f"{here}/{tiny_bundle}",
    }
    assert second == {"motion": "builtin:wave"}


def test_the_runtime_is_as_asked_or_the_fastest(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(configure, "load_profile", lambda name: f"profile {name}")
    monkeypatch.setattr(configure, "installed", lambda: ["ort"])
    monkeypatch.setattr(configure, "fastest_runtime", lambda *given: ("ort", str(given)))
    assert configure.requested_runtime("auto") == ("ort", "('profile host', ['ort'])")
    assert configure.requested_runtime("ort") == ("ort", "as asked")
    with pytest.raises(BadInputError, match=r"runtime: found 'tpu', expected auto or one of openvino, ort, qnn, cuda"):
        configure.requested_runtime("tpu")


def test_cuts_are_a_tensor_and_a_unit(tiny_bundle: Path) -> None:
    network = load_bundle(tiny_bundle).read_network()
    first, second = [cut.at for cut in cuts(network)][:2]
    assert configure.requested_cuts((f"{first}=gpu", f"{second}=cpu"), network) == (
        NetworkCut(at=first, unit="gpu"),
        NetworkCut(at=second, unit="cpu"),
    )
    assert configure.requested_cuts((), network) == ()
    for text in (f"{first}=npu", first, "=gpu="):
        with pytest.raises(BadInputError, match="TENSOR=UNIT, with UNIT one of cpu, gpu, dsp"):
            configure.requested_cuts((text,), network)
    with pytest.raises(BadInputError, match="quantised tensor"):
        configure.requested_cuts(("nowhere=gpu",), network)


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


def test_a_configuration_has_the_runtime_that_was_chosen(
    tiny_bundle: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(configure, "requested_runtime", lambda asked: ("qnn", f"not {asked}"))
    checked = configure.configure(RunOptions(avatar=str(tiny_bundle), runtime="ort"), tmp_path, lambda: None)
    assert checked.config.runtime == "qnn" and "runtime: qnn (not ort)" in checked.notes


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


def test_the_accuracy_of_a_run_is_of_each_avatar_as_the_run_draws_it(
    tiny_bundle: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Two avatars of one name in one tensor: each has its row, under its folder."""
    monkeypatch.setattr(configure, "accuracy_of", lambda bundle, drawn: {"of": bundle.folder, "drawn": drawn})
    other = Path(shutil.copytree(tiny_bundle, tmp_path / "other"))
    scene = tmp_path / "two.toml"
    rows = "".join(f'[[avatars]]\nbundle = "{folder}"\n' for folder in (tiny_bundle, other))
    scene.write_text('name = "two"\nsize = "64"\ntexture_filter = "mipmap"\n' + rows)
    request = RunOptions(scene=str(scene), runtime="ort", frames=1)
    drawn = DrawnAs("ort", "64", "mipmap", 2)
    assert configure.configure(request, tmp_path, lambda: None).accuracy == {
        f"tiny in {folder}": {"of": folder, "drawn": drawn} for folder in (tiny_bundle.absolute(), other)
    }


def test_a_background_is_looked_at_before_the_run(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    from trilane.stages.gpu import survey

    asked: list[Any] = []
    monkeypatch.setattr(survey, "survey", lambda *given: asked.append(given))
    monkeypatch.setattr(survey, "check_pictures", lambda *given: asked.append(given))
    scene = Scene(background=str(tmp_path / "a.png"), output=OutputSpec(width=100, height=64), fps=12.0, frames=7)
    staged: Any = SimpleNamespace(camera=SimpleNamespace(path="the camera"))
    configure._footage(scene)
    configure._check_pictures(scene, staged)
    assert asked == [(tmp_path / "a.png", 12.0), (tmp_path / "a.png", 12.0, 7, "the camera")]
    assert configure._footage(Scene()) is None
    configure._check_pictures(Scene(), staged)
    assert len(asked) == 2


# --- facts -----------------------------------------------------------------------------------------------------------


def test_facts_of_the_processor_are_the_flags_that_decide_in_their_order(monkeypatch: pytest.MonkeyPatch) -> None:
    flags = frozenset({"fpu", "amx_int8", "fma", "avx2", "f16c", "i8mm", "avx"})
    told = {"cores": (1, 4), "core_count": 6, "architecture": "x86_64", "cpu_model": "CPU 3000", "cpu_flags": flags}
    for name, value in told.items():
        monkeypatch.setattr(machine.here, name, lambda value=value: value)
    assert machine_facts.cpu_facts() == {
        "model": "CPU 3000",
        "architecture": "x86_64",
        "flags": ["avx2", "fma", "f16c", "amx_int8", "i8mm"],
        "cores": 6,
        "cores_allowed": [1, 4],
    }


@pytest.mark.parametrize(
    ("output", "expected"),
    [(b'{"vendor": "v"}', {"vendor": "v"}), (b"[1]", None), (b"crash", None), (None, None)],
    ids=["facts", "a list", "no JSON", "died"],
)
def test_the_driver_is_tried_in_a_process_of_its_own(monkeypatch: Any, output: Any, expected: Any) -> None:
    asked: list[Any] = []

    def run(command: list[str], **options: Any) -> Any:
        asked.append((command, options))
        if output is None:
            raise subprocess.CalledProcessError(-11, command)
        return SimpleNamespace(stdout=output)

    monkeypatch.setattr(machine_facts.subprocess, "run", run)
    assert machine_facts.gl_facts.__wrapped__() == expected
    command, options = asked[0]
    assert command[1:3] == ["-P", "-c"] and "open_gl()" in command[3]
    assert options == {"capture_output": True, "timeout": 30.0, "check": True}


def test_a_drivers_limits_are_those_that_it_tells(monkeypatch: pytest.MonkeyPatch) -> None:
    from trilane.stages.gpu import opengl

    info = {"GL_VENDOR": "v", "GL_RENDERER": "llvmpipe", "GL_VERSION": "4", "GL_MAX_TEXTURE_SIZE": 8, "GL_OTHER": 1}
    monkeypatch.setattr(opengl, "open_context", lambda: SimpleNamespace(info=info))
    assert machine_facts.open_gl() == {
        "vendor": "v",
        "renderer": "llvmpipe",
        "version": "4",
        "hardware": False,
        "limits": {"GL_MAX_TEXTURE_SIZE": 8},
    }


def test_facts_name_what_is_installed_and_nothing_else(monkeypatch: pytest.MonkeyPatch) -> None:
    versions = {"numpy": "1", "torch": "2", "trilane": "3"}
    monkeypatch.setattr(machine_facts, "package_version", versions.get)
    facts = machine_facts.machine_facts({"vendor": "v"})
    assert facts["packages"] == {"numpy": "1", "torch": "2"}
    assert (facts["trilane"], facts["gl"]) == ("3", {"vendor": "v"})
    assert facts["memory_bytes"] == machine.here.memory_bytes() and facts["cpu"] == machine_facts.cpu_facts()
    assert list(machine_facts.runtime_facts()) == ["onnxruntime"]
    assert machine_facts.machine_facts()["gl"] is None
    monkeypatch.undo()
    assert machine_facts.package_version("no-such-thing") is None
    assert machine_facts.package_version("numpy") == np.__version__


def config(folder: Path, **changes: Any) -> RunConfig:
    return RunConfig(scene=Scene(), out_dir=folder, avatar_dirs=(), units={}, **changes)


def test_what_a_configuration_leaves_out(tmp_path: Path) -> None:
    said = config(tmp_path)
    assert (said.runtime, said.record, said.posed_vertices, said.pace_ns, said.cuts) == ("ort", True, (), {}, ())
    assert RuntimeOptions() == RuntimeOptions(threads=1, spin=False, device={})


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
