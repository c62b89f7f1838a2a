"""Trains avatars of a capture or of clothed default bodies: renders samples, trains, quantises and measures.

Rule: finished work is kept in the work folder and not repeated. Each part of the work reports its expected duration
before it starts.
"""

from __future__ import annotations

import json
import math
import shlex
import shutil
import time
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import torch
from PIL import Image

from trilane.arrays import F32
from trilane.avatars.bundle import OFFSETS, Bundle, bundle_folder, load_bundle, write_manifest
from trilane.avatars.manifest import sha256_of
from trilane.avatars.validation import VALIDATION_SIZE
from trilane.errors import BadInputError
from trilane.files import read_text
from trilane.training.capture.capture_samples import CaptureRenderer
from trilane.training.clothing import KEY, look_named
from trilane.training.dataset import (
    FIELDS,
    Planned,
    ShapeGroup,
    open_groups,
    plan_training,
    write_dataset,
)
from trilane.training.first_texture import first_texture, used_texels
from trilane.training.hanging import dressed_body
from trilane.training.image_error import MEANS, ImageError, image_error
from trilane.training.make_bundle import (
    integer_network,
    keep_rounded_weights,
    kept_network,
    quantise_avatar,
    write_avatar,
    write_float_network,
)
from trilane.training.network import UNet
from trilane.training.objective import Vgg16, read_vgg16
from trilane.training.step_loop import (
    TrainingState,
    chosen_device,
    device_words,
    first_state,
    keep_freed_memory,
    load_state,
    memory_words,
    probe_loss,
    save_state,
    step_seconds,
    steps,
)
from trilane.training.subject import Subject, captured_subject, clothed_subject, subject_with_offsets
from trilane.training.surface import body_arrays
from trilane.training.trainable_avatar import (
    SIDES,
    NeuralTexture,
    TrainableAvatar,
    float_painter,
    load_network,
    network_of,
    save_network,
)
from trilane.training.training_settings import NAME, TrainingSettings, read_settings, settings_text
from trilane.training.validate import integer_painter, side_by_side
from trilane.units import AVATARS
from trilane.writing import PREFIX, write_atomically, write_bytes

CHANNELS = 16
DEFAULT_NETWORK = Path(__file__).with_name("default-network.npz")
SAMPLES, SAMPLE_FACTS, STATE, NETWORK, SHEETS = "samples", "samples.json", "state.npz", "network.npz", "sheets"
LOSS_BEFORE = "loss-before.json"
LEAST_STEPS = 10
#: Most sheets of a training, evenly over its steps, and least number of steps between two sheets. A sheet takes about
#: as long as a step.
SHEET_COUNT, SHEET_STEPS = 10, 10
#: Least number of seconds between two states that are written to the disk.
SAVE_S = 60.0
ANOTHER_WORK = "use another --work folder, or remove this one"


@dataclass(frozen=True)
class TrainingPlaces:
    """Folders and files of one training.

    `capture`: folder of the capture; None if the settings have a look. `out`: folder of the bundle. `work`: folder of
    samples, state and sheets. `name`: name of the avatar. With several looks, `out` and `work` have a folder for each.
    `vgg`: file of VGG-16's weights for the perceptual loss, or None.
    """

    capture: Path | None
    out: Path
    work: Path
    name: str
    vgg: Path | None = None


@dataclass(frozen=True)
class Trained:
    """One of the persons of a training.

    `subject`: person. `places`: folders of the person alone, and the name of the person's avatar.
    """

    subject: Subject
    places: TrainingPlaces


class Listener(Protocol):
    """Receives messages about the progress of the work."""

    def say(self, line: str) -> None:
        """Receive a line about a result, or about the expected duration of the next part of the work."""

    def track(self, text: str, numbers: Iterable[Any], total: int) -> Iterable[Any]:
        """Yield the `total` items of `numbers`, and show the progress of the work that `text` names."""

    def trained(self, step: int, total: int, terms: dict[str, float], loss: float) -> None:
        """Receive the `terms` of the loss after `step` of `total` steps, before weighting, and their weighted sum."""


def train_avatar(places: TrainingPlaces, asked: TrainingSettings, listener: Listener) -> dict[str, Any]:
    """Train as `asked`, write the bundles, and return facts about the training and the error on held-out frames.

    An interrupted training continues from its last state.
    Raises BadInputError for wrong settings or files, and FaultyCaptureError with all faults of the capture. Raises
    MissingPartError without OpenGL, or without a GPU or package that is asked for.
    """
    started = time.monotonic()
    settings = resumed_settings(places.work / NAME, with_vgg(asked, places.vgg))
    vgg = read_vgg16(places.vgg) if places.vgg is not None else None
    torch.set_num_threads(settings.threads)
    keep_freed_memory()
    listener.say(f"trains on {device_words(chosen_device(settings.device), settings.threads)}")
    if settings.loss.perceptual:
        listener.say(f"perceptual loss: {'MS-SSIM' if vgg is None else f'features of VGG-16 in {places.vgg}'}")
    people = []
    for subject, own in _subjects(places, settings, listener):
        own.work.mkdir(parents=True, exist_ok=True)
        _require_own_work(subject, own, settings)
        raised = _raised(subject, own, settings, listener)
        _draw_samples(raised, own, settings, listener)
        people.append(Trained(raised, own))
    groups = _groups(people)
    torch.manual_seed(settings.seed)
    avatar = _first_avatar(people, places, settings)
    settings = _with_steps(avatar, groups, settings, vgg, listener)
    write_bytes(places.work / NAME, settings_text(settings).encode())
    state = first_state(avatar, settings, vgg)
    before = places.work / LOSS_BEFORE
    if not (places.work / STATE).exists():  # a resumed training has the file
        write_bytes(before, json.dumps(probe_loss(state, groups)).encode())
    losses = {"before": float(_read_json(before))}
    _train(state, people, groups, places, settings, listener)
    state.average.cpu()
    if settings.bytes_from < 1 and not settings.keep_network:
        keep_rounded_weights(state.average, groups, settings.seed)
    state.average.to(state.device)
    losses["after"] = probe_loss(state, groups)  # of the weights that are written
    state.average.cpu()
    save_network(state.average, places.work / NETWORK)
    files = write_float_network(places.work, state.average, groups, settings.seed)
    network = kept_network(settings.start) if settings.keep_network else None
    network = network or integer_network(state.average, groups, settings.seed)
    made: dict[str, Any] = {"samples": settings.samples, "steps": state.step}
    made |= {"batch": settings.batch, "seed": settings.seed}
    made |= {"network_of": settings.start} if settings.keep_network else {}
    capture = [] if places.capture is None else [places.capture.name]
    command = shlex.join(["trilane", "avatar", "train", *capture, "--config", NAME])
    facts = {"avatar": str(places.out), "steps": state.step, "loss": losses}
    for number, person in enumerate(people):
        subject, own = person.subject, person.places
        quantised = quantise_avatar(state.average, network, subject.shaped, subject.unseen, number)
        provenance = made | {"texture_sides": list(SIDES)} | subject.facts
        names = {"name": own.name, "training_command": command}
        write_avatar(own.out, subject.person, quantised, settings.width, provenance, names)
        write_bytes(own.out / NAME, settings_text(settings).encode())
        facts |= {"held_out_error": _measure(own, subject, settings)} if subject.held_out else {}
        if subject.truth is not None:
            measure = ["trilane", "avatar", "validate", str(own.out), "--float-network", str(places.work / NETWORK)]
            listener.say(f"measure it on views that it was not trained on: {shlex.join(measure)}")
    sheets = str(places.work / SHEETS) if any(person.subject.held_out for person in people) else None
    return facts | files | {"sheets": sheets, "seconds": round(time.monotonic() - started, 1)}


def _subjects(
    places: TrainingPlaces, settings: TrainingSettings, listener: Listener
) -> Iterator[tuple[Subject, TrainingPlaces]]:
    """Yield the person of the capture, or the default body in each look of the settings, with the person's folders.

    Raises BadInputError if there are both a capture and a look, or neither.
    """
    if places.capture is not None:
        if settings.looks:
            raise BadInputError("look", repr(settings.look), "none beside a capture, which has a person of its own")
        yield captured_subject(places.capture, settings.threads, listener.say), places
        return
    if not settings.looks:
        raise BadInputError("CAPTURE", "none", "the folder of a capture", "or settings (--config) with a `look`")
    body = bundle_folder("default") / "body.npz"
    for look in settings.looks:
        look_named(look)  # an unknown look is refused before any work
    for look in settings.looks:
        alone = len(settings.looks) == 1
        own = places if alone else replace(places, out=places.out / look, work=places.work / look, name=look)
        yield clothed_subject(dressed_body(body, look, own.work), settings.threads, look), own


def _groups(people: Sequence[Trained]) -> list[ShapeGroup]:
    return [group for number, one in enumerate(people) for group in open_groups(one.places.work / SAMPLES, number)]


def with_vgg(asked: TrainingSettings, file: Path | None) -> TrainingSettings:
    """Return `asked` with the digest of `file`, the weights of VGG-16; unchanged without a file.

    Raises BadInputError for a digest without a file, a file with another digest, or a file without perceptual loss.
    """
    if file is None:
        if asked.vgg is not None:
            raise BadInputError("vgg", "no file of weights", f"that with SHA-256 {asked.vgg}", "give it with --vgg")
        return asked
    if not asked.loss.perceptual:
        raise BadInputError("--vgg", "a loss without `perceptual`", "a weight for it", "such as that of --loss thesis")
    digest = sha256_of([file])
    if asked.vgg not in (None, digest):
        raise BadInputError(file, f"SHA-256 {digest}", f"that of the settings, {asked.vgg}")
    return asked.model_copy(update={"vgg": digest})


def _raised(subject: Subject, places: TrainingPlaces, settings: TrainingSettings, listener: Listener) -> Subject:
    """Return `subject` with offsets of clothes and hair, if the settings want them; else unchanged."""
    if not settings.stand_off:
        return subject

    def track(views: list[Any]) -> Iterable[Any]:
        return listener.track("measuring outlines", views, len(views))

    return subject_with_offsets(subject, places.work / OFFSETS, settings.seed, listener.say, track)


def resumed_settings(path: Path, asked: TrainingSettings) -> TrainingSettings:
    """Return the settings in the file `path` of an interrupted training; without that file, `asked`.

    If `asked` has no number of steps, the file's number stays. Raises BadInputError when the file differs from `asked`.
    """
    if not path.exists():
        return asked
    begun = read_settings(path)
    if asked.steps is None:
        asked = asked.model_copy(update={"steps": begun.steps})
    one, other = begun.model_dump(), asked.model_dump()
    for key, value in one.items():
        if other[key] != value:
            raise BadInputError(f"{path}: {key}", f"a training with {value}", f"{other[key]}, as asked", ANOTHER_WORK)
    return begun


def _read_json(path: Path) -> Any:
    """Return the content of a file that `train_avatar` wrote into the work folder. Raises BadInputError."""
    expected = "a JSON file of this training"
    try:
        return json.loads(read_text(path, expected))
    except ValueError as error:
        raise BadInputError(path, f"no valid JSON ({error})", expected, ANOTHER_WORK) from None


def _require_own_work(subject: Subject, places: TrainingPlaces, settings: TrainingSettings) -> None:
    """Note in the work folder which samples and offsets it will have. Raises BadInputError if it has others."""
    facts = places.work / SAMPLE_FACTS
    decides = ("samples", "seed", "stand_off")
    who = {"look": subject.facts[KEY]} if places.capture is None else {"capture": str(places.capture.resolve())}
    body = {"body": sha256_of([subject.person.body])}
    wanted = who | body | {key: getattr(settings, key) for key in decides}
    if not facts.exists():
        if (there := places.work / SAMPLES).exists():
            raise BadInputError(there, f"samples without {SAMPLE_FACTS}", "samples with it", ANOTHER_WORK)
        write_bytes(facts, json.dumps(wanted).encode())
    elif (present := _read_json(facts)) != wanted:
        raise BadInputError(facts, str(present), str(wanted), ANOTHER_WORK)


def _draw_samples(subject: Subject, places: TrainingPlaces, settings: TrainingSettings, listener: Listener) -> None:
    """Render the samples into the work folder, if they are not there yet. The folder of samples is whole or absent."""
    folder, processes = places.work / SAMPLES, settings.threads
    if folder.exists():
        return
    samples = plan_training(
        subject.renderer,
        settings.samples,
        settings.seed,
        lambda all_: listener.track("choosing views", all_, len(all_)),
    )
    listener.say(_sample_cost(subject, samples, settings))
    draft = folder.with_name(f"{PREFIX}{SAMPLES}")
    shutil.rmtree(draft, ignore_errors=True)
    write_dataset(
        subject.source, samples, draft, processes, lambda parts: listener.track("drawing views", parts, len(parts))
    )
    draft.rename(folder)


def _sample_cost(subject: Subject, samples: list[Planned], settings: TrainingSettings) -> str:
    """Return a line about the time and disk space for rendering `samples`, estimated by rendering some of them."""
    start, tried = time.monotonic(), samples[:: max(1, len(samples) // 4)][:4]
    for sample in tried:
        subject.renderer.render(sample)
    seconds = (time.monotonic() - start) / len(tried) * len(samples) / settings.threads
    pixel = sum(int(np.prod(tail, dtype=int)) * np.dtype(kind).itemsize for tail, kind in FIELDS.values())
    megabytes = sum(sample.crop.shape[0] * sample.crop.shape[1] for sample in samples) * pixel / 1e6
    return (
        f"{len(samples)} views: about {seconds:.0f} s, {megabytes:.0f} MB on the disk (by {len(tried)} that were drawn)"
    )


def _first_avatar(people: Sequence[Trained], places: TrainingPlaces, settings: TrainingSettings) -> TrainableAvatar:
    """Return the avatar that training starts from.

    If the work folder has a saved state, only the shapes of the avatar's arrays matter: `_train` loads their values.
    """
    groups = _groups(people)
    network = UNet(norm=settings.norm, width=settings.width, channels=CHANNELS, input_skip=True)
    resumed = (places.work / STATE).exists()
    if settings.keep_network:
        network = network_of(load_bundle(settings.start), groups, settings.seed).requires_grad_(False)
    elif settings.start == "default" and not resumed:
        network = load_network(network, DEFAULT_NETWORK)
    elif settings.start != "new" and not resumed:
        network = network_of(load_bundle(settings.start), groups, settings.seed)
    empty = np.zeros((SIDES[0], SIDES[0], CHANNELS), np.float32)
    images = [empty if resumed else _first_image(person, number, settings) for number, person in enumerate(people)]
    return TrainableAvatar(network, *(NeuralTexture(image, mip_levels=settings.mip_levels) for image in images))


def _first_image(person: Trained, number: int, settings: TrainingSettings) -> F32:
    """Return the texture (S,S,C) from which the training of `person`, whose number is `number`, starts.

    If the settings name a bundled avatar, its texture is taken. Texels that only the body of `person` uses, such as a
    garment's, begin as in a new texture.
    """
    name = person.subject.facts.get(KEY) if settings.texture == "look" else settings.texture
    body = body_arrays(person.subject.shaped)

    def new() -> F32:
        return first_texture(body, open_groups(person.places.work / SAMPLES, number), SIDES[0], CHANNELS)

    if name not in AVATARS:
        return new()
    bundle = load_bundle(str(name))
    texture = bundle.read_texture()
    theirs = used_texels(body_arrays(bundle.shaped_body()), SIDES[0], 1)
    only_here = used_texels(body, SIDES[0], 1) & ~theirs
    return np.where(only_here[..., None], new(), texture) if only_here.any() else texture


def _with_steps(
    avatar: TrainableAvatar,
    groups: list[ShapeGroup],
    settings: TrainingSettings,
    vgg: Vgg16 | None,
    listener: Listener,
) -> TrainingSettings:
    """Return `settings` with a number of steps, and report the expected duration.

    If the settings have no number of steps, as many steps are chosen as fit into `minutes`.
    """
    seconds = step_seconds(avatar, groups, settings, vgg)
    count = settings.steps or max(LEAST_STEPS, int(60 * settings.minutes / seconds))
    memory = memory_words(chosen_device(settings.device))
    per_step = f"{seconds:.2f} s a step as just measured"
    listener.say(f"{count} steps: about {count * seconds / 60:.1f} min ({per_step}), {memory}")
    return settings.model_copy(update={"steps": count})


def _train(
    state: TrainingState,
    people: Sequence[Trained],
    groups: list[ShapeGroup],
    places: TrainingPlaces,
    settings: TrainingSettings,
    listener: Listener,
) -> None:
    """Do all remaining steps. At intervals, write a sheet, and write the state to the disk."""
    path, count = places.work / STATE, settings.steps or LEAST_STEPS
    if path.exists():
        load_state(state, path)
        listener.say(f"goes on after step {state.step} of {count}")
    weights, saved = settings.loss.by_name(), time.monotonic()
    every = max(SHEET_STEPS, math.ceil(count / SHEET_COUNT))
    for terms in steps(state, groups, settings, count):
        loss = sum(weights.get(name, 0.0) * value for name, value in terms.items())
        listener.trained(state.step, count, terms, loss)
        if state.step % every == 0 or state.step == count:
            write_sheet(places.work / SHEETS / f"step-{state.step:07}.png", state.average, people[0].subject)
        if time.monotonic() - saved > SAVE_S:
            save_state(state, path)
            saved = time.monotonic()
    save_state(state, path)


def _measure(places: TrainingPlaces, subject: Subject, settings: TrainingSettings) -> dict[str, Any]:
    """Measure the bundle on held-out frames, write the error into its manifest, and return the error."""
    assert subject.frames is not None
    bundle = load_bundle(places.out)
    facts = error_facts(frame_errors(bundle, subject.frames, subject.held_out, settings.threads))
    write_held_out_error(bundle, facts)
    return facts


# Sheets of a training on a capture: held-out frames beside the avatar's pictures of them.
#
# Rule: frames are cropped to the whole person, as in the measurement at the end. Painting does not change the training.

#: Most held-out frames on a sheet.
MOST_FRAMES = 6


def write_sheet(path: Path, avatar: TrainableAvatar, subject: Subject) -> None:
    """Write a PNG with up to `MOST_FRAMES` rows: a held-out frame, and the picture that `avatar` paints of it.

    Write nothing if `subject` has no held-out frames. Raises BadInputError when the file cannot be written.
    """
    paint, rows = float_painter(avatar.network, *(level.detach() for level in avatar.levels(0))), []
    for number in subject.held_out[:: max(1, len(subject.held_out) // MOST_FRAMES)][:MOST_FRAMES]:
        sample = subject.frames.whole_sample(number, VALIDATION_SIZE) if subject.frames is not None else None
        if sample is not None and subject.frames is not None:
            uv, truth = subject.frames.render(sample)
            rows.append(side_by_side((truth, paint(sample, uv))))
    if rows:
        path.parent.mkdir(exist_ok=True)
        with write_atomically(path) as draft:
            Image.fromarray(np.vstack(rows)).save(draft, format="png")


# The error of an avatar on held-out frames of a capture.
#
# Rule: the files of the bundle are measured, run as in the pipeline. Frames are cropped to the whole person, and
# nothing is random.

RUNTIME = "ort"


def frame_errors(bundle: Bundle, renderer: CaptureRenderer, numbers: Sequence[int], threads: int) -> list[ImageError]:
    """Return the errors of `bundle` on the frames `numbers`; frames that do not show the person are left out.

    The ground truth is the frame with its mask. Raises errors as `integer_painter` does.

    `renderer`: renderer of the capture. `threads`: number of the runtime's threads.
    """
    paint = integer_painter(renderer, bundle, RUNTIME, threads)
    errors = []
    for number in numbers:
        sample = renderer.whole_sample(number, VALIDATION_SIZE)
        if sample is None:
            continue
        uv, truth = renderer.render(sample)
        errors.append(image_error(paint(sample, uv), truth))
    return [error for error in errors if error is not None]


def error_facts(errors: Sequence[ImageError]) -> dict[str, Any]:
    """Return the means of `errors`, and how they were measured.

    Keys: `runtime`, `size` (tensor size), `frames` (number of frames), and the names of `MEANS` but `background`. If
    `errors` is empty, the means are left out.
    """
    names = [name for name in MEANS if name != "background"]
    means = (
        {name: round(float(np.mean([getattr(error, name) for error in errors])), 4) for name in names} if errors else {}
    )
    return {"runtime": RUNTIME, "size": VALIDATION_SIZE, "frames": len(errors), **means}


def write_held_out_error(bundle: Bundle, facts: dict[str, Any]) -> None:
    """Write `facts`, the error on held-out frames, into the provenance in the manifest of `bundle`."""
    provenance = bundle.manifest.provenance | {"held_out_error": facts}
    write_manifest(bundle.folder, bundle.manifest.model_copy(update={"provenance": provenance}))
