"""The subject of a training: the clothed default body or the person of a capture, with offsets of clothes and hair.

Rule: a `Subject` hides most differences between the two kinds from other modules.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.ndimage import map_coordinates
from scipy.sparse.linalg import spsolve

from trilane.arrays import F32, F64, U8, Ints, Mask
from trilane.avatars.bundle import as_kept, read_offsets, save_offsets
from trilane.avatars.manifest import CAPTURED
from trilane.body.body import ShapedBody, load_body
from trilane.body.joints import JOINTS
from trilane.body.skinning import blend_matrices
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
from trilane.training.dataset import SampleSource, clothed_source, plan_training
from trilane.training.sample_renderer import SampleRenderer
from trilane.training.surface import Smoother, vertex_normals
from trilane.writing import write_atomically


@dataclass(frozen=True)
class Person:
    """The person whom an avatar shows.

    `body`: file of the body. `betas`, `expression`: coefficients of its shape.
    `offsets`: vectors (V,3) from the skin to the drawn surface, metres at rest; None if the skin is drawn.
    """

    body: Path
    betas: tuple[float, ...] = ()
    expression: tuple[float, ...] = ()
    offsets: F32 | None = None


@dataclass(frozen=True)
class Subject:
    """The subject of a training, with the renderers of its samples.

    `shaped`: body of `person`, with its offsets. `renderer`: plans and renders samples. `opener`: function that takes
    offsets of the body and opens another such renderer, in any process. `facts`: facts for the manifest.
    `truth`: the renderer, if it can draw the ground truth of any pose and view; None for a capture.
    `frames`: the renderer, if it shows frames of a capture; else None. `held_out`: numbers of the held-out frames.
    `unseen`: texels (S,S) of the body that no training frame shows; None if `truth` can show all.
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
        """A function without arguments that opens another renderer like this subject's, in any process."""
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
    """Return the clothed body as a subject.

    `body`: body file. `threads`: number of threads of a software OpenGL driver. `name`: name of the look.
    Raises BadInputError for a wrong body file or an unknown look, MissingPartError without OpenGL.
    """
    look = look_named(name)
    shaped = load_body(body).shape(look.betas)
    facts = {"body": "the default body, clothed by trilane.training.clothing", KEY: name}
    renderer = SampleRenderer(shaped, threads=threads, look=look)
    person = Person(body, look.betas)
    return Subject(person, shaped, renderer, partial(clothed_source, body, name), facts, renderer)


def captured_subject(folder: Path, threads: int, report: Callable[[str], None]) -> Subject:
    """Return the person of the capture in `folder` as a subject. Samples show no held-out frame and no bad fit.

    `threads`: number of threads of a software OpenGL driver. `report`: called with lines about the frames and texels.
    Raises BadInputError for a capture.toml that cannot be read, FaultyCaptureError with all faults of the capture, and
    MissingPartError without OpenGL.
    """
    capture = open_capture(folder)
    frames, coverage, drawn = _checked(capture, threads)
    require_fits(capture, frames, "what `trilane avatar check-data` draws")
    bad = [frame.number for frame in bad_frames(frames)]
    kept, held_out = held_out_frames(len(capture), bad)
    report(f"{len(kept)} frames of {len(capture)} to train on; held out: {len(held_out)}, with bad fits: {len(bad)}")
    for number in kept:
        coverage.add(np.unpackbits(drawn[number]).astype(bool).reshape(coverage.used.shape))
    regions = coverage.never_seen()
    among = f", among them all of {', '.join(regions)}" if regions else ""
    share = f"{1 - coverage.share():.1%} of the body's texels are seen by no frame{among}"
    report(f"{share}: filled from seen ones, along the surface")
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
    """Return a new renderer, on one thread, of the frames `numbers` of `capture`.

    `offsets`: offsets (V,3) that the body is drawn with; None for none.
    """
    drawn = capture if offsets is None else replace(capture, shaped=capture.shaped.with_offsets(offsets))
    return CaptureRenderer(drawn, numbers, ViewRule(), threads=1)


def _checked(capture: Capture, threads: int) -> tuple[list[CheckedFrame], TexelCoverage, list[U8]]:
    """Return the checks of all frames of `capture`, an empty coverage, and the texels that each frame shows.

    The texels of a frame are packed by `np.packbits`, because a capture may have many frames.
    """
    raster, coverage = BodyRaster(capture.shaped, threads), coverage_of(capture)
    frames, drawn = [], []
    for number in range(len(capture)):
        frame, uv, mask = checked_frame(capture, raster, number)
        frames.append(frame)
        drawn.append(np.packbits(coverage.drawn(uv, mask)))
    return frames, coverage, drawn


# How far a person's clothes and hair stand off the body: offsets of the body's vertices, measured at the masks'
# outlines.
#
# Rule: an offset is measured only at vertices on the outline of the body, because a mask shows offsets only there.
# Other vertices get their offsets from neighbours on the surface.
#
# "SMPL+D" has the same offsets (Alldieck et al., Video Based Reconstruction of 3D People Models, CVPR 2018). There they
# are found by gradient descent, here by sampling the mask along the normals.

#: Range along the surface's normal in which the mask's outline is searched, and step of the search, metres.
INWARD_M, OUTWARD_M, STEP_M = -0.03, 0.1, 0.002
#: A vertex may be at the outline if the sine of the angle between its surface and the ray to the camera is below this.
RIM = 0.2
#: A vertex is at the outline if the body is drawn this many pixels inwards from it, and not this many pixels outwards.
BESIDE_PX = 1.5
#: Least number of pixels that a metre along the normal must span: fewer pixels are too inaccurate.
LEAST_PX_PER_M = 120.0
#: Number of measurements with which a vertex has the full weight.
ENOUGH = 12
#: Weight of the squared difference between neighbours, if the full weight of a measured vertex is 1.
STIFFNESS = 0.6
#: Number of smoothing steps of the normals, so that raised surfaces do not fold.
NORMAL_ROUNDS = 6


class Outline(NamedTuple):
    """One view of the person.

    `joints`: skinning matrices (55,3,4). `feature`: factors (486,) of pose blend shapes, or None. `view`, `projection`:
    camera matrices (4,4). `covered`: (h,w) bool, whether the body is drawn. `mask`: (h,w) in 0..1, coverage by the
    person.
    """

    joints: NDArray[np.floating]
    feature: NDArray[np.floating] | None
    view: F64
    projection: F64
    covered: NDArray[np.bool_]
    mask: F32


@dataclass(frozen=True)
class StandOff:
    """Measured offsets.

    `offsets`: (V,3), metres at rest. `measured`: share of the vertices with a measurement. The offsets of the other
    vertices are interpolated.
    """

    offsets: F32
    measured: float


def stand_off(shaped: ShapedBody, outlines: Iterable[Outline]) -> StandOff:
    """Return the offsets of the person in `outlines`.

    `shaped`: body that the outlines are drawn with. The result includes the offsets that this body already has.
    """
    faces = shaped.body.faces.astype(np.int64)
    rest = shaped.vertices.astype(np.float64)
    normals = smooth_normals(rest, faces)
    vertices, heights, weights = [], [], []
    for outline in outlines:
        number, height, weight = measured_heights(shaped, normals, outline)
        vertices.append(number)
        heights.append(height)
        weights.append(weight)
    middle, count = _medians(np.concatenate(vertices), np.concatenate(heights), np.concatenate(weights), len(rest))
    raised = smoothed(middle, np.minimum(count / ENOUGH, 1.0), faces)
    if shaped.body.skin is not None:
        raised[shaped.body.skin[0] :] = 0.0  # a garment is a mesh of its own, where it is seen
    before = 0 if shaped.body.offsets is None else shaped.body.offsets
    return StandOff((before + raised[:, None] * normals).astype(np.float32), float((count > 0).mean()))


def smooth_normals(vertices: F64, faces: Ints) -> F64:
    """Return unit vertex normals (V,3), smoothed over neighbours on the mesh."""
    normals = Smoother(faces, len(vertices)).smooth(vertex_normals(vertices, faces), NORMAL_ROUNDS)
    return np.asarray(normals / np.linalg.norm(normals, axis=1, keepdims=True))


def measured_heights(shaped: ShapedBody, normals: F64, outline: Outline) -> tuple[Ints, F64, F64]:
    """Return N vertices at the outline: indices (N,), distances (N,) to the mask's outline, weights (N,).

    A distance is along the vertex's normal, in metres, positive outwards. A weight is the number of pixels for a metre
    along the normal.

    `normals`: smoothed normals (V,3) at rest.
    """
    at, along_normal, true_normal = _posed(shaped, normals, outline)
    pixels = _Pixels(outline)
    start, reach = pixels.of(at), pixels.of(at + STEP_M * along_normal)
    speed = (reach - start) / STEP_M
    px_per_m = np.linalg.norm(speed, axis=1)
    eye = np.linalg.inv(outline.view)[:3, 3]
    ray = (eye - at) / np.linalg.norm(eye - at, axis=1, keepdims=True)
    rim = np.abs((ray * true_normal).sum(axis=1)) < RIM
    outward = BESIDE_PX * speed / np.maximum(px_per_m, 1e-9)[:, None]
    at_outline = pixels.covered(start - outward) & ~pixels.covered(start + outward)
    number = np.flatnonzero(rim & (px_per_m > LEAST_PX_PER_M) & at_outline)
    start, speed, px_per_m = start[number], speed[number], px_per_m[number]
    steps = np.arange(INWARD_M, OUTWARD_M + STEP_M / 2, STEP_M)
    line = start[:, None] + steps[:, None] * speed[:, None]
    end, found = _ends(pixels.mask(line))
    height = INWARD_M + STEP_M * end
    beyond = steps[None] * px_per_m[:, None] > BESIDE_PX
    crosses_body = (pixels.covered(line) & beyond & (steps[None] < height[:, None])).any(axis=1)
    usable = found & ~crosses_body
    return number[usable], height[usable], px_per_m[usable]


def smoothed(values: F64, certainty: F64, faces: Ints) -> F64:
    """Return values x (V,) that are smooth on the mesh and close to `values` v (V,) where `certainty` c (V,) is large.

    They minimise sum c (x - v)² + STIFFNESS sum over edges (x_i - x_j)². A connected part of the mesh without any
    measurement gets 0.
    """
    count = len(values)
    pairs = np.unique(np.sort(np.vstack([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]), axis=1), axis=0)
    ones = np.ones(len(pairs))
    edges = sparse.coo_matrix((ones, (pairs[:, 0], pairs[:, 1])), (count, count))
    edges = edges + edges.T
    degree = np.asarray(edges.sum(axis=1)).ravel()
    # The small term keeps the system regular if a part of the mesh has no measurement; it sets that part to 0.
    system = sparse.diags(certainty + STIFFNESS * degree + 1e-6) - STIFFNESS * edges
    return np.asarray(spsolve(system.tocsc(), certainty * values))


class _Pixels:
    """Reads the images `covered` and `mask` of an outline at given points."""

    def __init__(self, outline: Outline) -> None:
        self._outline = outline
        self._clip = outline.projection @ outline.view

    def of(self, points: F64) -> F64:
        """Return the pixel coordinates (N,2) of world `points` (N,3): x right, y down, from the top left corner."""
        height, width = self._outline.covered.shape
        clip = points @ self._clip[:, :3].T + self._clip[:, 3]
        over = clip[:, :2] / np.maximum(clip[:, 3:], 1e-6)
        return np.asarray((over * [1, -1] + 1) / 2 * [width, height])

    def covered(self, at: F64) -> NDArray[np.bool_]:
        """Return whether the body is drawn at the pixel coordinates `at` (...,2); False outside the picture."""
        return np.asarray(self._read(self._outline.covered.astype(np.float32), at, 0) > 0)

    def mask(self, at: F64) -> F64:
        """Return the mask at the pixel coordinates `at` (...,2), sampled bilinearly; NaN outside the picture."""
        return self._read(self._outline.mask, at, 1, np.nan)

    def _read(self, image: F32, at: F64, order: int, beyond: float = 0.0) -> F64:
        place = np.moveaxis(at[..., ::-1] - 0.5, -1, 0)
        return np.asarray(map_coordinates(image, place, order=order, mode="constant", cval=beyond), np.float64)


def _posed(shaped: ShapedBody, normals: F64, outline: Outline) -> tuple[F64, F64, F64]:
    """Return the posed vertices, the posed `normals`, and normals computed from the posed mesh; each (V,3), world."""
    rest = shaped.vertices.astype(np.float64)
    if outline.feature is not None and shaped.body.posedirs is not None:
        rest = rest + (shaped.body.posedirs.reshape(-1, len(outline.feature)) @ outline.feature).reshape(-1, 3)
    matrices = np.asarray(outline.joints, np.float64).reshape(JOINTS, 12)
    moved = blend_matrices(shaped.body.weights.astype(np.float64), matrices).reshape(-1, 3, 4)
    at = np.einsum("vab,vb->va", moved[:, :, :3], rest) + moved[:, :, 3]
    along = np.einsum("vab,vb->va", moved[:, :, :3], normals)
    return at, along, vertex_normals(at, shaped.body.faces.astype(np.int64))


def _ends(values: F64) -> tuple[F64, NDArray[np.bool_]]:
    """Return where each row of `values` (N,K) first falls below 0.5, as an index (N,), and whether it does (N,).

    The index is interpolated. A row that begins below 0.5, or reaches NaN first, does not count as falling.
    """
    inside = values >= 0.5
    first = np.argmin(inside, axis=1)
    rows = np.arange(len(values))
    low, high = values[rows, first], values[rows, np.maximum(first - 1, 0)]
    found = (first > 0) & ~inside[rows, first] & np.isfinite(low)
    with np.errstate(invalid="ignore", divide="ignore"):
        end = first - 1 + (high - 0.5) / (high - low)
    return np.where(found, end, 0.0), found


def _medians(number: Ints, value: F64, weight: F64, count: int) -> tuple[F64, F64]:
    """Return the weighted median (V,) of each vertex's values, 0 without values, and the number (V,) of values."""
    order = np.lexsort((value, number))
    number, value, weight = number[order], value[order], weight[order]
    total = np.bincount(number, weights=weight, minlength=count)
    before = np.cumsum(weight) - np.concatenate([[0.0], np.cumsum(total)])[number]
    chosen = np.flatnonzero((before >= total[number] / 2) & (before - weight < total[number] / 2))
    middle = np.zeros(count)
    middle[number[chosen]] = value[chosen]
    return middle, np.bincount(number, minlength=count).astype(np.float64)


# Finds the offsets of a subject: views of the subject are drawn and measured, then drawn again with the offsets that
# were found.
#
# Rule: only views that training may read are used, and the same seed finds the same offsets.

#: Number of measured views, and number of rounds. Each round draws the body with the offsets of the previous round, and
#: corrects these offsets.
VIEWS, ROUNDS = 300, 3
#: Added to the seed, so that the views differ from the training samples.
SEED = 7
#: Number of views that are measured first, to estimate the duration of all.
TRIED = 4


def subject_with_offsets(
    subject: Subject, path: Path, seed: int, report: Callable[[str], None], track: Callable[[Any], Any] = iter
) -> Subject:
    """Return `subject` with the offsets in the file `path`. If the file is missing, measure and write them first.

    `seed`: seed of the training; the views' seed follows from it. `report`: called with a line about the duration of
    the measurement. `track`: wraps the views of each round to show progress.
    Raises BadInputError for a file with other content, or a file that cannot be written.
    """
    if not path.exists():
        offsets = measured_offsets(subject, seed, report, track)
        with write_atomically(path) as draft, draft.open("wb") as file:
            save_offsets(file, offsets)
    return subject.with_offsets(read_offsets(path, len(subject.shaped.vertices)))


def measured_offsets(
    subject: Subject, seed: int, report: Callable[[str], None], track: Callable[[Any], Any] = iter
) -> F32:
    """Return the offsets (V,3), metres, from the skin of `subject` to the surface that the masks show.

    `subject_with_offsets` describes the parameters.
    """
    samples = plan_training(subject.renderer, VIEWS, seed + SEED)
    report(_cost(subject, samples))
    for _ in range(ROUNDS):
        found = stand_off(subject.shaped, outlines(subject, track(samples)))
        subject = subject.with_offsets(as_kept(found.offsets))
    assert subject.person.offsets is not None
    return subject.person.offsets


def _cost(subject: Subject, samples: Sequence[Any]) -> str:
    """Return a line about the duration of measuring `samples` in all rounds, estimated by measuring some of them."""
    tried = samples[:: max(1, len(samples) // TRIED)][:TRIED]
    normals = smooth_normals(subject.shaped.vertices.astype(np.float64), subject.shaped.body.faces.astype(np.int64))
    start = time.monotonic()
    for outline in outlines(subject, tried):
        measured_heights(subject.shaped, normals, outline)
    seconds = (time.monotonic() - start) / len(tried) * len(samples) * ROUNDS
    return (
        f"how far clothes and hair stand off: {len(samples)} views, {ROUNDS} times: about {seconds:.0f} s"
        f" (by {len(tried)} that were measured)"
    )


def outlines(subject: Subject, samples: Sequence[Any]) -> Iterator[Outline]:
    """Yield the outline of `subject` in each of `samples`, which its renderer planned."""
    renderer: Any = subject.renderer
    for sample in samples:
        uv, rgba = renderer.render(sample)
        view, placed = renderer.placed(sample)
        joints, feature = np.array(placed.joints), placed.feature
        mask = rgba[..., 3].astype(np.float32) / 255
        yield Outline(joints, feature, view, np.asarray(placed.clip_projection), uv[..., 2] > 0, mask)
