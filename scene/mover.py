"""An avatar in the scene: its motion, put on the floor at the avatar's place and heading.

Rule: `Mover.sample` gives pose and place at any time; a Mover never changes.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from trilane.arrays import F64
from trilane.body.body import ShapedBody
from trilane.body.kinematics import Skeleton
from trilane.scene.body_outline import feet, outline
from trilane.scene.floor import floor_lift, ground_rule, leg_length
from trilane.scene.motion.motion import Motion, bracket, wrapped_time
from trilane.scene.rotations import about
from trilane.scene.schema import AvatarSpec


@dataclass(frozen=True)
class Mover:
    """A motion in its place.

    `world` (4, 4): from the motion's space to the scene's. `scale`: factor on the pelvis's places, the ratio of the leg
    lengths. `shift` (3,): added to these places, minus the pelvis of the rest pose. `lift_times_s` (L,), `lift_m` (L,):
    metres by which the body is lifted onto the floor, linear between these times. `notes`: what was decided, for
    people.
    """

    motion: Motion
    world: F64
    scale: float
    shift: F64
    lift_times_s: F64
    lift_m: F64
    notes: tuple[str, ...]

    def sample(self, t_s: float) -> tuple[F64, F64]:
        """Pose (55, 3), axis-angle, and translation (3,), metres, at `t_s`; both before `world`."""
        pose, pelvis = self.motion.sample(t_s)
        translation = pelvis * self.scale + self.shift
        i, j, fraction = bracket(self.lift_times_s, wrapped_time(t_s, self.motion.duration_s, self.motion.wrap))
        translation[1] += self.lift_m[i] + (self.lift_m[j] - self.lift_m[i]) * fraction
        return pose, translation


def make_mover(spec: AvatarSpec, motion: Motion, body: ShapedBody) -> Mover:
    """`motion` on the floor for `body`, at the position and heading of `spec`."""
    leg = leg_length(body.joints)
    scale = leg / motion.leg_m if motion.leg_m else 1.0
    shift = -body.joints[0]
    rule = ground_rule(motion, spec.ground)
    skeleton = Skeleton(body.joints, body.body.parents)
    lift_times_s, lift_m = floor_lift(motion, skeleton, outline(body), shift, scale, rule, feet(body))
    world = np.eye(4)
    world[:3, :3] = about(1, np.radians(spec.heading_deg))
    world[:3, 3] = spec.position
    notes = [f"floor: {_GROUND_NOTES[rule]}"]
    if abs(scale - 1) > 0.01:
        notes.append(f"places scaled by {scale:.3f} for the avatar's legs")
    return Mover(motion, world, scale, shift, lift_times_s, lift_m, tuple(notes))


_GROUND_NOTES = {
    "frame": "the lowest point of the body touches it in every frame",
    "sequence": "the lowest point over the motion touches it",
    "stance": "feet that stand in the recording stand on it",
    "none": "heights as recorded",
}
