"""Reads motions of the SMPL family from dicts of arrays, whatever file they are in: AMASS, AIST++, GLAMR, smplx.

Rule: what the arrays are called is data (`smpl_layouts.py`). Joints that a layout does not have are at rest; other keys
are ignored. Of several persons the one with the most frames is read, and a note says so.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from trilane.arrays import F64
from trilane.errors import BadInputError
from trilane.scene.motion.pickled import ARRAYS, printable
from trilane.scene.motion.recorded import RawMotion
from trilane.scene.motion.romp_file import POSES, motion_of_frames
from trilane.scene.motion.smpl_layouts import EXPECTED, LAYOUTS, RATE_KEYS, Layout
from trilane.scene.motion.smpl_turns import Turns, turns_in
from trilane.scene.motion.smplx_npy import hands_note
from trilane.scene.motion.stored import Found, contents, tables_in
from trilane.scene.recordings import Detected

MAX_BETAS = 400
LARGEST_SCALE = 1e4
NO_RATE = "save it again with mocap_frame_rate=..., or its poses alone as .npy, which is played at 30/s"


def motion_of(where: str, source: str, values: Any, there: str = "") -> RawMotion:
    """The motion in `values`, which a file holds.

    `where`: the file. `source`: its ending, for people. `there`: what is in it, for messages, when `values` are not
    all. Raises BadInputError when no layout fits.
    """
    tables = [Found(f"{where}[{printable(name)}]" if name else where, name, table) for name, table in tables_in(values)]
    frames_of_romp = [table for table in tables if table.has(POSES)]
    if frames_of_romp:
        return motion_of_frames(frames_of_romp, source)
    layout, found = _layout_of(tables) or (None, [])
    if layout is None:
        raise BadInputError(where, there or contents(values), f"a motion: {EXPECTED}; or `{POSES}` (ROMP)", ARRAYS)
    read = [(_turns(layout, each), each) for each in found]
    turns, chosen = max(read, key=lambda one: len(one[0].turns))
    frames = len(turns.turns)
    rate, how = _rate(layout, chosen)
    places, place_notes = _places(layout, chosen, frames)
    kept = _measured(layout, chosen, frames)
    betas = _betas(layout, chosen)
    notes = (
        f"{layout.name} {source} ({turns.whose}, {turns.columns} columns), {frames} frames at {rate:g}/s ({how})",
        f"hands: {hands_note(turns.turns)}",
        f"betas: {'none' if betas is None else len(betas)}",
        *place_notes,
        *turns.notes,
        *_notes_on_persons(found, chosen),
        *((f"{int((~kept).sum())} frames that were not measured left out",) if not kept.all() else ()),
    )
    reason = " and ".join(f"`{key}`" for key in layout.needs)
    detected = Detected(
        f"{layout.name} {source} ({turns.whose})",
        f"{reason} of {turns.columns} columns",
        unit="m",
        rate=f"by `{how}`" if how in RATE_KEYS else how,
    )
    return RawMotion(
        np.arange(frames)[kept] / rate,
        turns.turns[kept],
        None if places is None else places[kept],
        betas,
        layout.up,
        notes,
        detected=detected,
        ups=layout.ups,
    )


def _layout_of(tables: list[Found]) -> tuple[Layout, list[Found]] | None:
    """The first layout that one of `tables` has, and all that have it."""
    for layout in LAYOUTS:
        found = [table for table in tables if all(table.has(key) for key in layout.needs)]
        if found:
            return layout, found
    return None


def _turns(layout: Layout, found: Found) -> Turns:
    """The turns of all of the layout's arrays, which add up since each has joints of its own."""
    parts, notes = [], []
    for array in layout.arrays:
        if not found.has(array.key):
            continue
        values = found.array(array.key)
        if not array.needed and values.shape[1:] not in ((width,) for width in array.widths):
            notes.append(f"`{array.key}` of shape {values.shape} left out: no turns of single joints")
            continue
        parts.append(turns_in(f"{found.where}[{array.key}]", values, array.widths))
        if len(parts[-1].turns) != len(parts[0].turns):
            raise BadInputError(
                f"{found.where}[{array.key}]", f"{len(values)} rows", f"{len(parts[0].turns)}, as `{layout.needs[0]}`"
            )
    whole = next(part for part in parts if part.whose)
    said = (*notes, *(note for part in parts for note in part.notes))
    return Turns(np.sum([part.turns for part in parts], axis=0), whole.columns, whole.whose, said)


def _rate(layout: Layout, found: Found) -> tuple[float, str]:
    for key in RATE_KEYS:
        if found.has(key):
            value = found.numbers(key)
            if value.size != 1 or not 1 <= value.item() <= 1000:
                raise BadInputError(
                    f"{found.where}[{key}]", str(value.tolist())[:80], "one rate from 1 to 1000 frames/s"
                )
            return float(value.item()), key
    if layout.rate_hz is None:
        raise BadInputError(found.where, "no frame rate", f"a key `{RATE_KEYS[0]}` or `{RATE_KEYS[1]}`", NO_RATE)
    return layout.rate_hz, layout.rate_why


def _places(layout: Layout, found: Found, frames: int) -> tuple[F64 | None, tuple[str, ...]]:
    """Places of the pelvis (T, 3), metres, or None; and notes."""
    key = layout.place
    if not found.has(key):
        return None, (f"no `{key}`: stays in place",)
    if found.array(key).shape != (frames, 3):
        first = layout.needs[0]
        raise BadInputError(
            f"{found.where}[{key}]", f"shape {found.array(key).shape}", f"({frames}, 3), a row for each of `{first}`"
        )
    places = found.numbers(key)
    notes: tuple[str, ...] = ()
    if found.has(layout.scale):
        scale = _scale(layout, found)
        places, notes = places / scale, (f"places divided by `{layout.scale}`, {scale:.4g}",)
    elif layout.scale:
        notes = (f"no `{layout.scale}`: places taken for metres",)
    return (places if layout.rest_pelvis is None else layout.rest_pelvis + places), notes


def _scale(layout: Layout, found: Found) -> float:
    value = found.numbers(layout.scale)
    if value.size != 1 or not 0 < value.item() <= LARGEST_SCALE:
        where = f"{found.where}[{layout.scale}]"
        raise BadInputError(where, str(value.tolist())[:80], f"one scale above 0, at most {LARGEST_SCALE:g}")
    return float(value.item())


def _measured(layout: Layout, found: Found, frames: int) -> NDArray[np.bool_]:
    """Which frames (T,) hold the person; all where the layout does not say."""
    if not found.has(layout.mask):
        return np.ones(frames, dtype=bool)
    mask = found.array(layout.mask)
    if mask.shape != (frames,) or mask.dtype.kind not in "biuf":
        raise BadInputError(f"{found.where}[{layout.mask}]", f"shape {mask.shape}", f"({frames},), true or false")
    return np.asarray(mask != 0)


def _betas(layout: Layout, found: Found) -> F64 | None:
    """The betas of the whole motion; the mean of those that each frame has."""
    if not found.has(layout.betas):
        return None
    where = f"{found.where}[{layout.betas}]"
    betas = found.numbers(layout.betas)
    flat = betas.mean(axis=0) if betas.ndim == 2 and len(betas) > 1 else betas.reshape(-1)
    if flat.size > MAX_BETAS or not np.isfinite(flat).all():
        raise BadInputError(where, f"{flat.size} values, some not finite or too many", "finite numbers")
    return flat


def _notes_on_persons(found: list[Found], chosen: Found) -> tuple[str, ...]:
    if len(found) == 1:
        return (f"read from {printable(chosen.name)}",) if chosen.name else ()
    return (f"{len(found)} persons in the file: {printable(chosen.name)}, the one with the most frames, is read",)
