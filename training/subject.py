"""The subject of a training: the default body, clothed, or the person of a capture.

Rule: only this module differs between the two; samples, training and bundle are the same.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from trilane.arrays import F32, U8, Mask
from trilane.avatars.manifest import CAPTURED
from trilane.body.body import ShapedBody, load_body
from trilane.training.capture.capture import Capture, open_capture
from trilane.training.capture.capture_samples import BodyRaster, CaptureRenderer, ViewRule, held_out_frames
from trilane.training.capture.check import (
    CheckedFrame,
    TexelCoverage,
    bad_frames,
    checked_frame,
    coverage_of,
    require_fits,
    texel_facts,
)
from trilane.training.clothing import DEFAULT_NAME, KEY, look_named
from trilane.training.dataset import SampleSource, clothed_source
from trilane.training.sample_renderer import SampleRenderer


@dataclass(frozen=True)
class Person:
    """The person whom an avatar shows.

    `body`: file of the body. `betas`, `expression`: coefficients of its shape.
    `offsets` (V,3): vectors from the skin to the drawn surface, metres at rest; None for none.
    """

    body: Path
    betas: tuple[float, ...] = ()
    expression: tuple[float, ...] = ()
    offsets: F32 | None = None


@dataclass(frozen=True)
class Subject:
    """The subject of a training, with everything that draws it.

    `person`, `shaped`: the person and the body. `renderer`: plans and renders samples. `opener`: opens another renderer
    like it, also in another process; its body is drawn with the offsets that `opener` is given. `facts`: facts for the
    manifest.
    `truth`: renders the person in any pose and view; None where only frames are known. `frames`: renders those frames,
    else None. `held_out`: numbers of the frames that are kept for measuring.
    `unseen` (S,S): texels of the body that no training frame shows; None where all can be drawn.
    """

    person: Person
    shaped: ShapedBody
    renderer: SampleSource[Any]
    opener: Callable[[F32 | None], SampleSource[Any]]
    facts: dict[str, Any]
    truth: SampleRenderer | None = None
    frames: CaptureRenderer | None = None
    held_out: tuple[int, ...] = ()
    unseen: Mask | None = None

    @property
    def source(self) -> Callable[[], SampleSource[Any]]:
        """A function that opens another renderer like this subject's."""
        return partial(self.opener, self.person.offsets)

    def with_offsets(self, offsets: F32) -> Subject:
        """Return the same subject, drawn with `offsets` (V,3)."""
        renderer: Any = self.opener(offsets)
        return replace(
            self,
            person=replace(self.person, offsets=offsets),
            shaped=self.shaped.with_offsets(offsets),
            renderer=renderer,
            truth=None if self.truth is None else renderer,
            frames=None if self.frames is None else renderer,
        )


def clothed_subject(body: Path, threads: int, name: str = DEFAULT_NAME) -> Subject:
    """Return the body in the file `body`, in the look `name`.

    `threads`: threads of a software OpenGL driver. Raises BadInputError.
    """
    look = look_named(name)
    shaped = load_body(body).shape(look.betas)
    facts = {"body": "the default body, clothed by trilane.training.clothing", KEY: name}
    renderer = SampleRenderer(shaped, threads=threads, look=look)
    person = Person(body, look.betas)
    return Subject(person, shaped, renderer, partial(clothed_source, body, name), facts, renderer)


def captured_subject(folder: Path, threads: int, report: Callable[[str], None]) -> Subject:
    """Return the person of the capture in `folder`, without frames whose fits are bad and held-out frames.

    `threads`: threads of a software OpenGL driver. `report`: takes a line that says how many frames these are.
    Raises BadInputError; FaultyCaptureError with all faults.
    """
    capture = open_capture(folder)
    frames, coverage, drawn = _checked(capture, threads)
    require_fits(capture, frames, "what `trilane avatar check-data` draws")
    bad = [frame.number for frame in bad_frames(frames)]
    kept, held_out = held_out_frames(len(capture), bad)
    report(f"{len(kept)} frames of {len(capture)} to train on; held out: {len(held_out)}, with bad fits: {len(bad)}")
    for number in kept:
        coverage.add(np.unpackbits(drawn[number]).astype(bool).reshape(coverage.used.shape))
    report(_unseen_line(coverage))
    names = {"held_out": held_out, "bad": bad}
    facts = {
        "body": CAPTURED,
        "frames": len(capture),
        **{f"{key}_frames": [capture.names[number] for number in numbers] for key, numbers in names.items()},
        "texels": texel_facts(coverage),
    }
    person = Person(capture.body_file, tuple(map(float, capture.betas)), tuple(map(float, capture.expression)))
    opener = partial(capture_source, capture, tuple(kept))
    renderer = opener(None)
    shown = (None, renderer, tuple(held_out), coverage.unseen)
    return Subject(person, capture.shaped, renderer, opener, facts, *shown)


def capture_source(capture: Capture, numbers: Sequence[int], offsets: F32 | None) -> CaptureRenderer:
    """Open a renderer of the frames `numbers` of `capture`, on one thread; the body is drawn with `offsets` (V,3)."""
    drawn = capture if offsets is None else replace(capture, shaped=capture.shaped.with_offsets(offsets))
    return CaptureRenderer(drawn, numbers, ViewRule(), threads=1)


def _checked(capture: Capture, threads: int) -> tuple[list[CheckedFrame], TexelCoverage, list[U8]]:
    """Check the frames of `capture`; return them, a coverage that counted none, and each frame's packed texels."""
    raster, coverage = BodyRaster(capture.shaped, threads), coverage_of(capture)
    frames, drawn = [], []
    for number in range(len(capture)):
        frame, uv, mask = checked_frame(capture, raster, number)
        frames.append(frame)
        drawn.append(np.packbits(coverage.drawn(uv, mask)))
    return frames, coverage, drawn


def _unseen_line(coverage: TexelCoverage) -> str:
    """Say which share of the texels no frame shows, and on which regions of the body."""
    regions = coverage.never_seen()
    names = f", among them all of {', '.join(regions)}" if regions else ""
    share = f"{1 - coverage.share():.1%} of the body's texels are seen by no frame{names}"
    return f"{share}: filled from seen ones, along the surface"
