"""Validates an avatar: what lies in its bundle is evaluated on held-out samples, and its manifest says how good it is.

Rule: bundle, seeds, motions, size and runtimes alone decide the figures; the digests are of the files that were read.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from trilane import machine
from trilane.avatars.bundle import Bundle, write_manifest
from trilane.avatars.manifest import AT_THE_TOP, MadeWith, Validation, digests_of, sha256_of, with_figures_digest
from trilane.scene.motion.load import load_motion
from trilane.scene.motion.motion import Motion
from trilane.scene.schema import AvatarSpec
from trilane.stages.dsp.runtime import load_runtime
from trilane.stages.machine_facts import package_version
from trilane.training.clothing.looks import look_of
from trilane.training.dataset import VALIDATION_SIZE, plan_validation
from trilane.training.error_summary import SampleError, summary
from trilane.training.evaluate import Evaluated, Painter, evaluate, integer_painter
from trilane.training.sample_renderer import SampleRenderer

BUILTIN_HELD_OUT = "builtin:walk-wave-turn"
#: Seeds of a validation; the worst of 96 samples differs by several dB from seed to seed.
SEEDS = (1, 2, 3, 4, 5, 6, 7, 8)
PER_BAND = 24
#: The painter of the float network, beside those that have the names of runtimes.
FLOAT = "float"
#: Who looks at each sample of a seed when it was evaluated.
Look = Callable[[int, Evaluated], None]


@dataclass(frozen=True)
class ValidationPlan:
    """What an avatar is evaluated on.

    `held_out`: motions that poses come from, `builtin:NAME` or files. `seeds`: of the samples, `per_band` of each band
    for each. `runtimes`: the first one's figures are the avatar's, the others stand beside. `size`: tensor size.
    `threads`: of a software OpenGL driver and of each runtime. `revision`, `modified`: of Trilane's checkout, where
    known.
    """

    held_out: tuple[str, ...] = (BUILTIN_HELD_OUT,)
    seeds: tuple[int, ...] = SEEDS
    per_band: int = PER_BAND
    runtimes: tuple[str, ...] = ("ort",)
    size: str = VALIDATION_SIZE
    threads: int = 1
    revision: str | None = None
    modified: bool | None = None


@dataclass(frozen=True)
class FloatNetwork:
    """The network before it was quantised. `name`: for the manifest. `paint`: its painter."""

    name: str
    paint: Painter


def held_out_motions(names: Iterable[str]) -> list[Motion]:
    """The motions `names`. Raises BadInputError."""
    return [load_motion(AvatarSpec(motion=name), Path.cwd()) for name in names]


def open_renderer(bundle: Bundle, threads: int) -> SampleRenderer:
    """The renderer of the samples of `bundle`'s body. Raises BadInputError, MissingPartError."""
    return SampleRenderer(bundle.shaped_body(), threads, look=look_of(bundle.manifest.provenance))


def validate(
    bundle: Bundle,
    plan: ValidationPlan,
    renderer: SampleRenderer,
    float_network: FloatNetwork | None = None,
    look: Look = lambda _seed, _sample: None,
) -> Validation:
    """Evaluate `bundle` and return its validation.

    `bundle`: whose files are read.
    `plan`: the samples and the runtimes.
    `renderer`: of `open_renderer`.
    `float_network`: evaluated beside; None for none.
    `look`: gets every sample; painters have the names of runtimes and `FLOAT`.
    Raises BadInputError, MissingPartError.
    """
    digests = digests_of(bundle.folder, bundle.manifest)
    motions = held_out_motions(plan.held_out)
    painters = {name: integer_painter(renderer, bundle, name, plan.threads) for name in plan.runtimes}
    if float_network is not None:
        painters[FLOAT] = float_network.paint
    errors: dict[str, list[SampleError]] = {name: [] for name in painters}
    for seed in plan.seeds:
        samples = plan_validation(renderer, plan.per_band, seed, motions, plan.size)
        for sample in evaluate(renderer, samples, painters):
            look(seed, sample)
            for name, error in sample.errors.items():
                errors[name].append(SampleError(seed, sample.number, sample.band, error))
    figures = {name: summary(found) for name, found in errors.items()}
    validation = Validation.model_validate(
        {
            "date": machine.here.now().date(),
            "digests": digests,
            "made_with": _made_with(plan, renderer),
            "size": plan.size,
            "per_band": plan.per_band,
            "held_out": {Path(name).name: _origin(name) for name in plan.held_out},
            **_arranged(figures, plan.runtimes, float_network.name if float_network is not None else ""),
        }
    )
    return with_figures_digest(validation)


def revalidate(bundle: Bundle, validation: Validation) -> Bundle:
    """Write `validation` into the manifest of `bundle` and return the bundle with it. Raises BadInputError."""
    manifest = bundle.manifest.model_copy(update={"validation": validation})
    write_manifest(bundle.folder, manifest)
    return Bundle(bundle.folder, manifest)


def _made_with(plan: ValidationPlan, renderer: SampleRenderer) -> MadeWith:
    return MadeWith(
        trilane=package_version("trilane"),
        revision=plan.revision,
        modified=plan.modified,
        renderer=str(renderer.ctx.info["GL_RENDERER"]),
        runtimes={name: load_runtime(name).version() for name in plan.runtimes},
    )


def _arranged(figures: Mapping[str, dict[str, Any]], runtimes: tuple[str, ...], float_network: str) -> dict[str, Any]:
    """The keys of a validation with `figures` of each painter."""
    first, *others = runtimes
    own = figures[first]
    arranged: dict[str, Any] = {
        **{key: own[key] for key in AT_THE_TOP},
        "runtime": first,
        "integer": own,
        "other_runtimes": {name: figures[name] for name in others},
    }
    if FLOAT in figures:
        by_band = figures[FLOAT]["psnr_db_by_band"]
        arranged["float"] = {"network": float_network, **figures[FLOAT]}
        arranged["psnr_loss_db"] = {
            band: round(by_band[band] - psnr, 2) for band, psnr in own["psnr_db_by_band"].items()
        }
    return arranged


def _origin(motion: str) -> str:
    """What the motion is beyond its name: built in, or the digest of its file."""
    return "built in" if motion.startswith("builtin:") else f"sha256 {sha256_of([Path(motion)])}"
