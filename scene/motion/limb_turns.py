"""Turns of arms, legs, hands, feet and fingers: a bone points where the recorded one points.

Rule: what a direction leaves open, the twist about the bone, follows the file's own turns, so it never flips where a
limb is straight. The file's turns are right up to one constant angle, which no zero pose is needed for: it is the one
at which elbows and knees bend, toes and fingers point, on average over the recording, as those of the avatar do.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from trilane.arrays import F64
from trilane.scene.motion.frame_turns import TOO_SHORT, beside, least_turns, transposed, turned
from trilane.scene.motion.tracks import unit
from trilane.scene.rotations import matrix_from_rotvec

#: Of a sine: below it a limb counts as straight, so that a knee bent backwards a little turns nothing round.
LEAST_BEND = np.sin(np.radians(15.0))

#: What tells the twist: a direction in the avatar at rest (3,), and where it points in the recording (T, 3); how long
#: these are beside the bone is their weight.
Evidence = tuple[F64, F64]


def limb_turns(bone: F64, recorded: F64, carrier: F64, evidence: Sequence[Evidence]) -> F64:
    """Global turns (T, 3, 3) that lay the avatar's rest bone (3,) on the recorded ones (T, 3).

    `carrier` (T, 3, 3): turns that the bone takes part in, of which only the change over time counts. `evidence`: what
    tells the twist; without any it is the least one from the rest pose to the carrier.
    """
    target = unit(recorded)
    within = unit(turned(transposed(carrier), target).mean(axis=0))
    held = least_turns(turned(carrier, within), target) @ carrier
    laid = least_turns(bone[None], within[None])[0]
    return np.asarray(held @ _twist(held, within, laid, evidence) @ laid)


def _twist(held: F64, axis: F64, laid: F64, evidence: Sequence[Evidence]) -> F64:
    """The turn (3, 3) about `axis` (3,) that brings all of the evidence closest to the recorded directions."""
    cosine = sine = 0.0
    inside = transposed(held)
    for ours, theirs in evidence:
        expected = unit(beside((laid @ ours)[None], axis[None]))
        found = beside(turned(inside, theirs), axis[None]).sum(axis=0)
        cosine += float(found @ expected[0])
        sine += float(found @ np.cross(axis, expected[0]))
    if np.hypot(cosine, sine) < TOO_SHORT:
        return np.eye(3)
    return matrix_from_rotvec(axis * np.arctan2(sine, cosine))


def hinge(upper: F64, lower: F64) -> F64:
    """Axes (T, 3) about which a limb bends from `upper` to `lower` (T, 3); the more it bends the longer, up to 1."""
    axes = np.cross(unit(upper), unit(lower))
    sines = np.linalg.norm(axes, axis=-1, keepdims=True)
    return np.asarray(axes * np.clip(1 - LEAST_BEND / np.maximum(sines, TOO_SHORT), 0.0, 1.0))


def swung(parent: F64, bone: F64, recorded: F64) -> F64:
    """Turns (T, 3, 3) that lay `bone` (3,) on the recorded ones (T, 3) with the least turn from `parent` (T, 3, 3)."""
    return least_turns(turned(parent, bone), recorded) @ parent
