"""Who an avatar is trained of: the default body, clothed, or the person of a capture.

Rule: this alone differs between the two; samples, training and bundle are the same.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from trilane.avatars.manifest import CAPTURED
from trilane.body.body import ShapedBody, load_body
from trilane.training.capture.body_raster import BodyRaster
from trilane.training.capture.capture import open_capture
from trilane.training.capture.capture_samples import CaptureRenderer, held_out_frames
from trilane.training.capture.check import bad_frames, checked_frame
from trilane.training.capture.check_facts import require_fits
from trilane.training.capture.zoomed_view import ViewRule
from trilane.training.dataset import SampleSource, clothed_source
from trilane.training.sample_renderer import SampleRenderer


@dataclass(frozen=True)
class Person:
    """Whose avatar it is. `body`: the file. `betas`, `expression`: coefficients of its shape."""

    body: Path
    betas: tuple[float, ...] = ()
    expression: tuple[float, ...] = ()


@dataclass(frozen=True)
class Subject:
    """Who is trained.

    `person`, `shaped`: the body. `renderer`: plans and renders samples. `source`: opens another one like it, in another
    process. `facts`: for the manifest. `truth`: renders the person in any pose and view; None where only frames are
    known: then `frames` has them, of which those `held_out` are for measuring.
    """

    person: Person
    shaped: ShapedBody
    renderer: SampleSource[Any]
    source: Callable[[], SampleSource[Any]]
    facts: dict[str, Any]
    truth: SampleRenderer | None = None
    frames: CaptureRenderer | None = None
    held_out: tuple[int, ...] = ()


def clothed_subject(body: Path, threads: int) -> Subject:
    """The body in the file `body`, clothed. `threads`: of a software OpenGL driver. Raises BadInputError."""
    shaped = load_body(body).shape()
    facts = {"body": "the default body, clothed by trilane.training.clothing"}
    renderer = SampleRenderer(shaped, threads=threads)
    return Subject(Person(body), shaped, renderer, partial(clothed_source, body), facts, renderer)


def captured_subject(folder: Path, threads: int, report: Callable[[str], None]) -> Subject:
    """The person of the capture in `folder`; frames whose fits are bad, and those held out, are left out.

    `threads`: of a software OpenGL driver. `report`: takes a line that says how many frames these are.
    Raises BadInputError; FaultyCaptureError with all faults.
    """
    capture = open_capture(folder)
    raster = BodyRaster(capture.shaped, threads)
    frames = [checked_frame(capture, raster, number)[0] for number in range(len(capture))]
    require_fits(capture, frames, "what `trilane avatar check-data` draws")
    bad = [frame.number for frame in bad_frames(frames)]
    kept, held_out = held_out_frames(len(capture), bad)
    report(f"{len(kept)} frames of {len(capture)}; {len(held_out)} are held out, {len(bad)} have bad fits")
    names = {"held_out": held_out, "bad": bad}
    facts = {
        "body": CAPTURED,
        "frames": len(capture),
        **{f"{key}_frames": [capture.names[number] for number in numbers] for key, numbers in names.items()},
    }
    person = Person(capture.body_file, tuple(map(float, capture.betas)), tuple(map(float, capture.expression)))
    source = partial(CaptureRenderer, capture, tuple(kept), ViewRule(), threads=1)
    renderer = source()
    return Subject(person, capture.shaped, renderer, source, facts, None, renderer, tuple(held_out))
