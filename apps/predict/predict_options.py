"""The options of a prediction, each as one field, for `trilane predict` and `trilane.predict`.

Rule: a field checks its own value, and `check_together` checks combinations. The modules of the chip's model define the
valid words. They are imported only when a word is checked, because their import takes long.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Final

from pydantic import AfterValidator, BeforeValidator, Field

from trilane.errors import BadInputError
from trilane.options import Finite, Name, OnePath, Option, Options, Text, Texts, one_of, paths_of
from trilane.scheduler.policy import MOST_FRAMES, PACED_WORDS, POLICIES, POLICY_WORDS
from trilane.stages.run_options import PROFILE_HELP
from trilane.transport.slots import DEFAULT_EDGE, EDGE_WORDS
from trilane.unexpected_value import UnexpectedValue
from trilane.units import (
    AVATARS_HELP,
    BURST,
    HOST,
    MAX_CHANNELS,
    MAX_MINUTES,
    PERFORMANCE_PROFILES,
    SUSTAINED,
    UNITS,
    UnitName,
    either,
)

if TYPE_CHECKING:
    from trilane.hw_profiles.application import Variant
    from trilane.hw_profiles.rates import Wanted
    from trilane.hw_profiles.schema import EngineRuntime

ENCODER_HELP: Final = "resnet18, mobilenetv2, mobilenetv3 or efficientnet-lite0."
NORM_HELP: Final = "batch, instance or group."
#: Beginning of the help text of each option in `OF_A_FILE`.
PUBLISHED: Final = "For a published network: "
FIXED_SIZE_HELP: Final = "Tensor size in pixels: one side, or HEIGHTxWIDTH."
#: Precision as given by the user -> precision in a hardware profile.
PRECISIONS: Final = {"w8a8": "int8", "int8": "int8", "float": "fp16", "fp16": "fp16", "fp32": "fp32"}
#: Options that select a published network in place of an avatar's network.
OF_A_FILE: Final = {"encoder", "norm", "size", "channels"}
OF_THE_APPLICATION: Final = {"layout", "policy", "edge", "batch", "gpu_share", "what_if", "plot", "trace"}
#: Option -> options that have no effect beside it.
IGNORED: Final = {
    "avatar": OF_A_FILE | {"input_shape"},
    "network": OF_A_FILE | {"avatar"},
    "table": OF_A_FILE
    | {"layout", "avatar", "network", "application", "unit", "minutes", "gpu_share", "governor", "what_if", "plot"}
    | {"fps", "power_limit_w", "precision", "input_shape", "trace"},
}
WHY_IGNORED: Final = {
    "avatar": "the avatar's network says so itself",
    "network": "the file says so itself",
    "table": "each row says so itself",
}
#: Options that may stand beside a scene.
OF_A_SCENE: Final = {"scene", "beside", "turns", "profile", "minutes", "policy", "edge", "performance_profile"} | {
    "governor",
    "trace",
    "precision",
}
#: Value of `unit` that requests all units, to compare them.
ALL_UNITS: Final = "all"
#: Options that need a pipeline file.
OF_A_PIPELINE_ALONE: Final = {"changes", "frames", "measured", "seed"}
#: All options that may stand beside a pipeline file.
OF_A_PIPELINE: Final = OF_A_PIPELINE_ALONE | {"scene", "profile", "performance_profile", "runtime", "precision"}


def _either(read_words: Callable[[], tuple[str, ...]], expected: str = "") -> AfterValidator:
    """Return a validator that accepts None and the words that `read_words` returns.

    `read_words` is called only when a value is checked. `expected`: description of the valid words for error messages;
    "" for the words themselves.
    """

    def known(text: str | None) -> str | None:
        if text is not None and text not in (words := read_words()):
            raise UnexpectedValue(repr(text), expected or " or ".join(words))
        return text

    return AfterValidator(known)


def _runtimes() -> tuple[str, ...]:
    from trilane.hw_profiles.schema import ENGINE_RUNTIMES

    return tuple(ENGINE_RUNTIMES)


def _governors() -> tuple[str, ...]:
    from trilane.hw_profiles.governor import GOVERNORS

    return tuple(GOVERNORS)


def _turns() -> tuple[str, ...]:
    from trilane.scheduler.shared_units import TURNS

    return tuple(TURNS)


def _rate(fps: float | None) -> float | None:
    from trilane.hw_profiles.application import LEAST_FPS, MOST_FPS

    if fps is not None and not LEAST_FPS <= fps <= MOST_FPS:
        raise UnexpectedValue(f"{fps:g}", f"{LEAST_FPS:g} to {MOST_FPS:g}")
    return fps


def _watts(limit: float | None) -> float | None:
    if limit is not None and not 0 < limit < float("inf"):
        raise UnexpectedValue(f"{limit:g}", "watts above 0")
    return limit


def shape_of(text: str) -> tuple[str, tuple[int, ...]]:
    found = re.fullmatch(r"(.+)=(\d{1,9}(?:x\d{1,9})*)", text)
    if found is None or 0 in (sizes := tuple(map(int, found[2].split("x")))):
        raise UnexpectedValue(repr(text), "a name and sizes, such as image=1x3x224x224")
    return found[1], sizes


def _shapes(texts: tuple[str, ...]) -> tuple[str, ...]:
    names = [shape_of(text)[0] for text in texts]
    if twice := [name for name in names if names.count(name) > 1]:
        raise UnexpectedValue(f"{twice[0]!r} twice", "each input once")
    return texts


class PredictOptions(Options):
    """The options of `trilane predict`, in the order of its help."""

    scene: Annotated[Name | None, Option(is_argument=True)] = Field(
        default=None,
        description="A scene to predict frame by frame, in place of a network: a name, a file, or SCENE@RATE. "
        "Or a pipeline file (.toml).",
    )
    changes: Annotated[Texts, Option("--set")] = Field(
        default=(),
        description="For a pipeline file: change a key: stages.seg.unit=dsp. Separate several keys by commas. "
        "May be given again.",
    )
    frames: int | None = Field(
        default=None, ge=1, le=MOST_FRAMES, description="For a pipeline file: number of frames to simulate."
    )
    measured: OnePath | None = Field(
        default=None,
        description="For a pipeline file: folder of a run of this file here, whose stage times are used. For a "
        "chip, each time is multiplied by the stage's `scale`.",
    )
    seed: int = Field(default=0, ge=0, le=2**32 - 1, description="For a pipeline file: seed of its random times.")
    beside: Texts = Field(
        default=(),
        description="Further pipeline on the chip: SCENE, SCENE@RATE, NETWORK.onnx@RATE, @RATE:gpu, or a pipeline file "
        "(.toml, .toml@RATE). Repeat it.",
    )
    turns: Annotated[str, _either(_turns)] = Field(
        default="round-robin",
        description="Which pipeline gets a unit next when several wait for it: round-robin or deadline.",
    )
    profile: Name = Field(default="snapdragon-888", description=PROFILE_HELP)
    encoder: str = Field(default="resnet18", description=f"{PUBLISHED}{ENCODER_HELP}")
    norm: str = Field(default="batch", description=f"{PUBLISHED}{NORM_HELP}")
    size: Text = Field(default="512", description=f"{PUBLISHED}{FIXED_SIZE_HELP}")
    channels: int = Field(default=16, description=f"{PUBLISHED}channels of the neural texture, 1 to {MAX_CHANNELS}.")
    layout: Annotated[str, _either(lambda: ("packed", "split"))] = Field(
        default="packed", description="packed: one raster pass; split: one for every 4 channels."
    )
    avatar: Name | None = Field(default=None, description=f"Predict the network of an avatar: {AVATARS_HELP}")
    network: Annotated[tuple[Path, ...], BeforeValidator(paths_of)] = Field(
        default=(),
        description="ONNX file of a network by itself, without raster and composite. Repeat it.",
    )
    application: Annotated[bool, Option("--application")] = Field(
        default=False, description="Predict the avatar application with the --network, not the network by itself."
    )
    input_shape: Annotated[Texts, AfterValidator(_shapes)] = Field(
        default=(), description="Shape of an input of a --network: NAME=1x3x224x224. Repeat it."
    )
    precision: Annotated[str | None, _either(lambda: tuple(PRECISIONS), "w8a8 (int8), float (fp16) or fp32")] = Field(
        default=None, description="w8a8 (int8), float (fp16) or fp32; if not given, the network and its unit decide."
    )
    runtime: Annotated[str | None, _either(_runtimes)] = Field(
        default=None,
        description="Runtime of a tensor engine for a --network by itself: tflite (if not given) or qnn_dlc.",
    )
    unit: str = Field(
        default="dsp",
        description="Unit of the network: gpu or dsp. For a --network by itself also cpu, or all to compare units.",
    )
    minutes: Annotated[Finite, Option(unit="minutes")] = Field(
        default=0.0,
        ge=0,
        le=MAX_MINUTES,
        description="Virtual minutes to predict with heat. With 0, the settled state is predicted, without heat.",
    )
    policy: Annotated[str | None, one_of("reference", *POLICIES), Option(synonyms=("--pipelining",))] = Field(
        default=None,
        description=f"{POLICY_WORDS}; pipelined if not given, as in a run. Or reference: the policy "
        "of the published application, and the default with --encoder, --norm, --size or --channels.",
    )
    edge: str | None = Field(
        default=None, description=f"Buffers between stages: {EDGE_WORDS}; {DEFAULT_EDGE} if not given."
    )
    batch: int = Field(default=1, description="Frames in one job of the network.")
    fps: Annotated[float | None, AfterValidator(_rate)] = Field(
        default=None,
        description="Frame rate to judge: whether the chip holds this rate, and at which power. If not given, "
        f"{PACED_WORDS} use 30.",
    )
    power_limit_w: Annotated[float | None, AfterValidator(_watts)] = Field(
        default=None, description="Also predict the highest rate at which the device stays within this many watts."
    )
    gpu_share: Finite = Field(default=0.0, description="Share of the network that the GPU computes for the DSP.")
    performance_profile: Annotated[str, Option(words=PERFORMANCE_PROFILES)] = Field(
        default=SUSTAINED, description="Power mode of the units, which sets their speed. The names are SNPE's."
    )
    governor: Annotated[str | None, _either(_governors)] = Field(
        default=None, description="Rule against heat: step_wise or power_allocator; if not given, the profile's rule."
    )
    what_if: Annotated[bool, Option("--what-if")] = Field(
        default=False,
        description="Compare policies and edges for the same network; with --fps, every policy with every edge.",
    )
    plot: OnePath | None = Field(
        default=None, description="File for a drawing of frame rate and temperature (.png, .svg, .pdf)."
    )
    trace: OnePath | None = Field(
        default=None, description="File for the simulated run as a trace, for ui.perfetto.dev (docs/explain.md)."
    )
    table: OnePath | None = Field(default=None, description="CSV file of configurations; each row is predicted.")

    @property
    def is_bare(self) -> bool:
        """Return whether networks are predicted by themselves, without the application."""
        return bool(self.network) and not self.application

    @property
    def cap(self) -> str:
        """Return the performance profile that the user gave; without one, return the usual performance profile.

        `burst` is usual for a network by itself, because published latencies are measured under it. `burst` is also
        usual for a pipeline file, and for this machine, where a run has no cap. For any other prediction,
        `sustained_high_performance` is usual.
        """
        if "performance_profile" in self.model_fields_set:
            return self.performance_profile
        return BURST if self.is_bare or self.pipeline is not None or self.profile == HOST else SUSTAINED

    @property
    def pipeline(self) -> Path | None:
        """Return the pipeline file to predict by itself.

        Return None if `scene` is no pipeline file, or if other pipelines share the chip (`beside`).
        """
        from trilane.pipeline.pipeline_file import is_pipeline_file

        path = None if self.scene is None or self.beside else Path(self.scene)
        return path if path is not None and is_pipeline_file(path) else None

    @property
    def shapes(self) -> dict[str, tuple[int, ...]]:
        """Return the shapes in `input_shape`, by the input's name."""
        return dict(map(shape_of, self.input_shape))

    @property
    def numbers(self) -> str | None:
        """Return the number format of `precision`, as hardware profiles name it; None without `precision`."""
        return None if self.precision is None else PRECISIONS[self.precision]

    @property
    def engine(self) -> EngineRuntime | None:
        """Return `runtime`, the runtime of a tensor engine; None if the user gave none."""
        from trilane.hw_profiles.schema import ENGINE_RUNTIMES

        return next((runtime for runtime in ENGINE_RUNTIMES if runtime == self.runtime), None)

    @property
    def units(self) -> tuple[UnitName, ...]:
        """Return the units on which each network is predicted by itself. Raises BadInputError for an unknown unit."""
        return UNITS if self.unit == ALL_UNITS else (self.network_unit,)

    @property
    def network_unit(self) -> UnitName:
        """Return the unit of the network. Raises BadInputError if `unit` is not the name of one possible unit."""
        units: tuple[UnitName, ...] = ("cpu", "gpu", "dsp") if self.is_bare else ("gpu", "dsp")
        for unit in units:
            if unit == self.unit:
                return unit
        words = (*units, ALL_UNITS) if self.is_bare else units
        raise BadInputError("--unit", repr(self.unit), either(words))

    @property
    def wanted(self) -> Wanted:
        """Return the frame rate and the power limit that the prediction judges. Each is None if the user gave none."""
        from trilane.hw_profiles.rates import Wanted

        return Wanted(self.fps, self.power_limit_w)

    @property
    def is_published(self) -> bool:
        """Return whether the application runs a published network, not the network of an avatar or a file.

        A table counts as a published network.
        """
        return bool(self.model_fields_set & (OF_A_FILE | {"table"}))

    @property
    def is_as_run(self) -> bool:
        """Return whether network, policy, edge and batch are the same as in `trilane run` without options."""
        return not (self.is_published or self.model_fields_set & {"avatar", "network", "policy", "edge", "batch"})

    @property
    def variant(self) -> Variant:
        """Return policy, edge and batch of the application.

        If no policy is given, the policy is `pipelined`, as in a run. For a published network on another chip than this
        machine, the default policy is `reference`.

        Raises BadInputError for the policy `reference` with an edge that the published application does not have.
        """
        from trilane.hw_profiles.application import REFERENCE, Variant

        policy = self.policy or ("reference" if self.is_published and self.profile != HOST else "pipelined")
        if policy != "reference":
            rate = {} if self.fps is None else {"fps": self.fps}
            return Variant(policy, self.edge or DEFAULT_EDGE, self.batch, **rate)
        if self.edge not in (None, REFERENCE.edge):
            remedy = "choose a --policy of your own, such as pipelined"
            expected = f"{REFERENCE.edge}, which the reference application has"
            raise BadInputError("--edge", repr(self.edge), expected, remedy)
        return REFERENCE._replace(batch=self.batch)

    def check_together(self) -> None:
        """Raise BadInputError if an option has no effect beside another, or needs another that is not given."""
        self._check_pipeline_file()
        if self.pipeline is None:
            self._check_others()

    def _check_others(self) -> None:
        given = self.model_fields_set
        if self.beside and self.scene is None:
            raise BadInputError("options", "--beside without a scene", "a scene, such as `trilane predict default`")
        if self.scene is not None and (useless := given - OF_A_SCENE):
            found = f"{self._spelt(useless)} beside a scene"
            raise BadInputError("options", found, "none of them", "a scene has networks and stages of its own")
        if self.scene is None and "turns" in given:
            raise BadInputError("options", "--turns without a scene", "a scene with --beside, whose jobs take turns")
        for option, others in IGNORED.items():
            if option in given and (useless := given & others):
                found = f"{self._spelt(useless)} beside --{option}"
                raise BadInputError("options", found, "one or the other", WHY_IGNORED[option])
        self._check_engine()
        if self.is_bare and "table" not in given and (useless := given & OF_THE_APPLICATION):
            found, remedy = f"{self._spelt(useless)} with a network by itself", "they belong to the application"
            remedy += ": add --application for it with this network"
            raise BadInputError("options", found, "it without them", remedy)
        if self.application and len(self.network) != 1:
            found = f"--application with {len(self.network)} networks"
            remedy = "it says that the application runs the network of the file"
            raise BadInputError("options", found, "one --network", remedy)
        if self.input_shape and not self.network:
            raise BadInputError("options", "--input-shape without --network", "a network whose input it is")

    def _check_engine(self) -> None:
        given = self.model_fields_set
        if "runtime" in given and self.unit == ALL_UNITS:
            found, remedy = "--runtime beside --unit all", "units differ in the runtimes that are known of them"
            raise BadInputError("options", found, "one or the other", remedy)
        if "runtime" in given and not self.is_bare:
            remedy = "the application runs as its profile says"
            raise BadInputError("options", "--runtime", "a --network by itself beside it", remedy)

    def _check_pipeline_file(self) -> None:
        given = self.model_fields_set
        if self.pipeline is not None and (useless := given - OF_A_PIPELINE):
            found, remedy = f"{self._spelt(useless)} beside a pipeline file", "the file says so itself, or --set does"
            raise BadInputError("options", found, "none of them", remedy)
        if self.pipeline is None and (useless := given & OF_A_PIPELINE_ALONE):
            found = f"{self._spelt(useless)} {'with --beside' if self.beside else 'without a pipeline file'}"
            raise BadInputError("options", found, "a pipeline file by itself, a .toml with [stages]")

    def _spelt(self, names: set[str]) -> str:
        return ", ".join(sorted(map(self.spelling, names)))
