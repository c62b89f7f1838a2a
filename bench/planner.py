"""What does planning save against a fixed square of 512 x 512, and what does it cost in image error?

Rule: both plans run in interleaved rounds, on the same moments of the same scenes. The units are placed as by `trilane
run`. The runs' own stages make the compared pictures, in the timed configurations. The reference is the plan `full`, a
second implementation (`bench/lib/full_picture.py`). People see single bad frames, but means hide them. Therefore every
frame of both plans is also compared with the truth, which is quicker to draw than `full`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np

from trilane.arrays import U8
from trilane.bench.lib.cast import Cast
from trilane.bench.lib.full_picture import FullPictures, true_pictures
from trilane.bench.lib.picture_error import PictureErrors, box_psnr_db, psnr_of_frames, require_metrics
from trilane.bench.lib.stage_chain import AvatarFrames
from trilane.bench.pipeline import finished_run
from trilane.errors import BadInputError
from trilane.pipeline.unit_starter import UnitStarter
from trilane.scheduler.stats import median_interval
from trilane.stages import PRELOAD
from trilane.stages.configure import Checked, configure
from trilane.stages.gpu.opengl import describe
from trilane.stages.placing import placed
from trilane.stages.run_options import RunOptions
from trilane.units import MEASURED
from trilane.writing import write_folder

SCENES = ("portrait", "full-body", "crowd", "walk-past", "top-to-floor", "leave-and-return")
POLICY = "pipelined"
LEAST_FRAMES = 20
#: Factor on differences from `full` in the sheets.
SHOWN = 8
#: Tensor size of the reference application.
FIXED = "512x512"


def fixed(checked: Checked) -> Checked:
    """Return `checked` with the plan of the reference application.

    In every frame, the tensor is a square of the size `FIXED`, and everything is modelled.
    """
    scene = checked.config.scene.model_copy(update={"size": FIXED, "plan": "fixed"})
    return checked.changed(scene=scene, shapes=())


def planned(checked: Checked) -> Checked:
    """Return `checked` unchanged, with the scene's own plan."""
    return checked


#: Name of a plan -> function that applies it to a configuration.
PLANS = {"fixed": fixed, "planned": planned}


def in_frames(checked: Checked, frames: int) -> Checked:
    """Return `checked` with only `frames` frames, at a lower rate, so that these frames span the whole scene.

    A scene that has no more than `frames` frames stays unchanged.
    """
    scene = checked.config.scene
    if frames >= scene.frames:
        return checked
    fewer = {"frames": frames, "fps": scene.fps * frames / scene.frames}
    return checked.changed(scene=scene.model_copy(update=fewer))


def measure(
    scene: tuple[str, ...] = SCENES,
    frames: int = 100,
    rounds: int = 6,
    pictures: int = 8,
    runtime: str = "auto",
    video: bool = True,
    out: str = "",
) -> dict[str, Any]:
    """Compare a planned run with a run of a fixed tensor in each scene, by speed and by image error.

    `scenes` has an entry for each scene:
    `name`: name of the scene.
    `fixed_ms`, `planned_ms`: median frame times.
    `speedup`: fixed frame time divided by planned frame time, as the median over the rounds.
    `speedup_low`, `speedup_high`: 95 % interval of `speedup`; with fewer than six rounds, its least and largest value.
    `placements`: cores of the units and the reason for them, by plan.
    `psnr_fixed_db`, `psnr_planned_db`, `ssim_*`, `flip_*`: image errors against the plan `full`; PSNR follows from the
    mean square over all compared frames. The same keys after `box_`: errors in the avatars' rectangles; null if no
    avatar is in view.
    `truth`: the same errors, also of the plan `full`, against the clothed body that a bundled avatar was trained on;
    null for other avatars.
    `network`: source of the network of `full`.
    `tensors`: sizes of planned tensors.
    `by_frame`: errors of single frames against the truth; null without a truth.

    Further keys, over all scenes:
    `median_speedup`, `least_speedup`: median and least speedup.
    `largest_loss_db`: largest loss in a scene, which is the PSNR of fixed minus the PSNR of planned.
    `worst_loss_db`: the same for the worst frame of each plan; null without a truth.
    `sources`: source of the figures.
    `driver`: facts about the OpenGL driver.
    `config`: settings.

    Raises BadInputError for an option out of range or a wrong scene, MissingPartError if a library is not installed,
    TrilaneError if a run fails.
    """
    _check(frames, pictures)
    require_metrics()
    if out:
        with write_folder(Path(out)):
            pass  # fails before the work if the folder cannot be written
    found = [_Scene(name, frames, runtime, video=video) for name in scene]
    rows = []
    with UnitStarter(PRELOAD) as starter:
        for one in found:
            row, sheets = one.compare(pictures)
            rows.append({"name": one.name, **one.time(rounds, starter), **row})
            if out:
                _write(Path(out), one.name, sheets)
    known = [row["by_frame"] for row in rows if row["by_frame"]]
    losses_db = [plans["fixed"]["worst_psnr_db"] - plans["planned"]["worst_psnr_db"] for plans in known]
    return {
        "scenes": rows,
        "median_speedup": median(row["speedup"] for row in rows),
        "least_speedup": min(row["speedup"] for row in rows),
        "largest_loss_db": max(row["psnr_fixed_db"] - row["psnr_planned_db"] for row in rows),
        "worst_loss_db": max(losses_db, default=None),
        "sources": {"scenes": MEASURED},
        "driver": found[-1].driver,
        "config": {"frames": frames, "rounds": rounds, "pictures": pictures, "runtime": runtime, "video": video},
    }


def _check(frames: int, pictures: int) -> None:
    if frames < LEAST_FRAMES:
        raise BadInputError("--frames", str(frames), f"at least {LEAST_FRAMES}")
    if not 1 <= pictures <= frames:
        raise BadInputError("--pictures", str(pictures), f"1 to {frames}, the frames of a run")


@dataclass(frozen=True)
class _Moment:
    """The pictures of one frame by every plan, each (h,w,3) uint8 sRGB.

    `number`: number of the frame. `full`: picture by the plan `full`. `plans`: pictures by name in `PLANS`.
    `true`: true picture; None if unknown.
    """

    number: int
    full: U8
    plans: Mapping[str, U8]
    true: U8 | None


class _Scene:
    """One scene, which is run and compared by both plans. `driver`: facts about OpenGL; empty before `compare`."""

    def __init__(self, name: str, frames: int, runtime: str, *, video: bool) -> None:
        """Configure both plans.

        `name`: name or file of the scene. `frames`: largest number of frames of a run. `runtime`: runtime of the
        networks. `video`: whether a video is encoded.
        Raises BadInputError for a scene that cannot be read, MissingPartError if a library is not installed.
        """
        asked = RunOptions(scene=name, runtime=runtime, hud=False)
        checked = in_frames(configure(asked, Path.cwd()).changed(record=video), frames)
        self.name = checked.config.scene.name
        self.driver: dict[str, Any] = {}
        self._checked = checked
        self._plans = {plan: make(checked) for plan, make in PLANS.items()}

    def time(self, rounds: int, starter: UnitStarter) -> dict[str, Any]:
        """Measure the frame times of both plans in interleaved rounds.

        Return the keys `fixed_ms`, `planned_ms`, `speedup`, `speedup_low`, `speedup_high` and `placements` of
        `measure`. A rehearsal chooses the cores of the units. If the scene is too short for it, or if there is only one
        core, the rule for any run chooses them.
        `rounds`: number of rounds. `starter`: unit starter.
        Raises TrilaneError if a run fails.
        """
        on_cores = {plan: placed(one, POLICY, starter, str(self.driver)) for plan, one in self._plans.items()}
        times: dict[str, list[float]] = {plan: [] for plan in self._plans}
        for _ in range(rounds):
            for plan, checked in on_cores.items():
                times[plan].append(_frame_ms(checked, f"{self.name}, {plan}", starter))
        ratios = [slow / fast for slow, fast in zip(times["fixed"], times["planned"], strict=True)]
        low, high = median_interval(ratios)
        middle = {f"{plan}_ms": median(values) for plan, values in times.items()}
        said = {plan: checked.notes[-1] for plan, checked in on_cores.items()}
        return {"speedup": median(ratios), "speedup_low": low, "speedup_high": high, **middle, "placements": said}

    def compare(self, pictures: int) -> tuple[dict[str, Any], list[tuple[int, U8]]]:
        """Compare both plans with the plan `full` and with the truth. Return (figures, sheets).

        The figures have the keys of `measure` for image errors. The sheets are (number, picture by `sheet`) of each
        compared frame. `pictures`: number of compared frames, evenly spread over the scene; `by_frame` has all frames.
        """
        cast, total = Cast(self._checked), self._checked.config.scene.frames
        full = FullPictures(cast)
        first = AvatarFrames(self._checked)
        chains = {plan: AvatarFrames(checked, first.units) for plan, checked in self._plans.items()}
        self.driver = asdict(describe(first.gl))
        true = true_pictures(cast, first.gl)
        against_full = {plan: PictureErrors() for plan in chains}
        against_true = {plan: PictureErrors() for plan in ("full", *chains)}
        frame_by_frame = by_frame(range(total), chains, first, true.frame, cast) if true is not None else None
        sheets, tensors = [], []
        for number in (index * total // pictures for index in range(pictures)):
            background, boxes = first.background(number), cast.boxes(number)
            made = {plan: chain.frame(number) for plan, chain in chains.items()}
            tensors.append(chains["planned"].tensor)
            wanted = full.frame(number, background)
            for plan, errors in against_full.items():
                errors.add(made[plan], wanted, boxes)
            shown = true.frame(number, background) if true is not None else None
            if shown is not None:
                for plan, errors in against_true.items():
                    errors.add({"full": wanted, **made}[plan], shown, boxes)
            sheets.append((number, sheet(_Moment(number, wanted, made, shown))))
        return {
            **_figures(against_full),
            "truth": _figures(against_true) if true is not None else None,
            "network": "; ".join(full.networks),
            "tensors": sorted(set(tensors)),
            "by_frame": frame_by_frame,
        }, sheets


def by_frame(
    frames: Iterable[int],
    chains: Mapping[str, AvatarFrames],
    behind: AvatarFrames,
    true: Callable[[int, U8], U8],
    cast: Cast,
) -> dict[str, Any] | None:
    """Return the image error of single frames against the truth, in the boxes of the avatars, by plan.

    `frames`: numbers of the frames, ascending. `chains`: maker of the frames, by plan. `behind`: maker of the
    backgrounds. `true`: function of a frame's number and background that makes the true picture. `cast`: avatars and
    camera of the scene.
    The entry of a plan has the keys of `psnr_of_frames`, over the frames with a visible avatar, and `worst_frame`, the
    number of the worst frame. The entry of `planned` has two further keys. `changes`: number of frames whose tensor
    has another shape than in the previous frame, if both show an avatar. `worst_change_db`: least PSNR of these frames;
    None without such frames. If no frame shows an avatar, the result is None.
    """
    errors: dict[str, dict[int, float]] = {plan: {} for plan in chains}
    tensors: dict[int, str] = {}
    for number in frames:
        made = {plan: chain.frame(number) for plan, chain in chains.items()}
        boxes = cast.boxes(number)
        if boxes:
            wanted = true(number, behind.background(number))
            tensors[number] = chains["planned"].tensor
            for plan, picture in made.items():
                errors[plan][number] = box_psnr_db(picture, wanted, boxes)
    if not tensors:
        return None
    found: dict[str, Any] = {
        plan: {**psnr_of_frames([*each.values()]), "worst_frame": min(each, key=lambda number: each[number])}
        for plan, each in errors.items()
    }
    changed = [number for number, tensor in tensors.items() if tensors.get(number - 1, tensor) != tensor]
    worst = min((errors["planned"][number] for number in changed), default=None)
    found["planned"] |= {"changes": len(changed), "worst_change_db": worst}
    return found


def _figures(errors: Mapping[str, PictureErrors]) -> dict[str, float | None]:
    return {key: value for plan, each in errors.items() for key, value in each.figures(plan).items()}


def _frame_ms(checked: Checked, what: str, starter: UnitStarter) -> float:
    frame_ms = finished_run(checked, what, policy=POLICY, starter=starter).report.frame_time_ms.mean
    assert frame_ms is not None  # two frames were presented
    return frame_ms


def sheet(moment: _Moment) -> U8:
    """Return one picture (2 h, 3 w, 3) uint8 that shows the pictures of `moment`, each (h,w,3), in two rows.

    The upper row has `full`, `fixed` and `planned`. The lower row has the true picture (grey if unknown), and `SHOWN`
    times the differences of `fixed` and `planned` from `full`, around grey.
    """
    above = [moment.full, *moment.plans.values()]
    below = [np.full_like(moment.full, 128) if moment.true is None else moment.true]
    for picture in moment.plans.values():
        steps = (picture.astype(np.int16) - moment.full) * SHOWN + 128
        below.append(np.clip(steps, 0, 255).astype(np.uint8))
    return np.vstack([np.hstack(above), np.hstack(below)])


def _write(folder: Path, name: str, sheets: Sequence[tuple[int, U8]]) -> None:
    """Write each of `sheets`, (frame number, picture), to `folder` as `NAME-FRAME.png`.

    Raises BadInputError if the folder cannot be written.
    """
    from PIL import Image

    with write_folder(folder) as draft:
        for number, picture in sheets:
            Image.fromarray(picture).save(draft / f"{name}-{number}.png")
