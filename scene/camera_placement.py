"""The camera in the scene: places a recorded camera so that it films the avatars, and lets a person steer it.

A recorded camera is moved as one rigid piece: its path is turned about the vertical and shifted. Its movement from
frame to frame never changes. `best_place` finds the place. At the first frame, the camera is in front of the avatars,
in the direction of heading 0. Over a drawn background, the camera may also be tilted by one constant angle, so that it
does not look down on people. The tilt is left out if it would hide people. Places are judged by the scene's first
seconds, whatever the length and rate of a run. Therefore a frame of a scene shows the same picture in every run.

A built-in camera is a formula of time for a person at the origin. The camera goes along with the avatars if they would
leave the picture: its place moves by the mean of the avatars' ways. A way is an avatar's smoothed path over the floor.
A way repeats as its motion does, so no frame depends on earlier frames. Steps and sways are smoothed out of a way,
because they would shake the camera.

A person who steers turns the view about the vertical through a pivot, then about the level axis to the camera's right.
The camera stays upright, above the floor and off the pole. If the scene's own camera is beyond these limits, steering
turns the camera no further out. Zooming moves the camera along the line to the pivot; the lens stays the same.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from trilane.arrays import F64, Shape
from trilane.body.body import ShapedBody
from trilane.body.joints import JOINT_NAMES
from trilane.scene.camera.path import CameraPath, view_from_pose
from trilane.scene.motion.motion import Wrap, bracket, wrapped_time
from trilane.scene.mover import HEAD, Mover
from trilane.scene.rotations import about, quat_from_matrix, quat_multiply
from trilane.scene.schema import MAX_DEPTH_RATIO, CameraSpec, Scene
from trilane.scene.visibility import SCORED_MOMENTS, SCORED_S, best_place, facing, filming, outermost_points, seen_at
from trilane.units import ROOM

#: Step between samples of a way, seconds, and most samples; a longer motion has longer steps.
STEP_S, MOST_SAMPLES = 0.1, 6000
#: Standard deviation, seconds, of the Gaussian that smooths a way. A sixth of a sway of 1 Hz remains, and nothing of a
#: step of 2 Hz. A runner at 6 m/s who turns back at once is 1.4 m from the smoothed way.
SMOOTH_S = 0.3
#: Number of standard deviations at which the Gaussian is cut off.
ENDS_AFTER = 3.0
#: Mode of `np.pad` that continues a way beyond its ends, by what follows the motion's last frame.
PADDING = {Wrap.LOOP: "wrap", Wrap.BOUNCE: "reflect", Wrap.HOLD: "edge"}


@dataclass(frozen=True)
class Way:
    """The smoothed way of an avatar over the floor.

    `times_s` (T,): times from 0, strictly increasing. `places` (T, 3): positions on the floor, metres.
    `wrap`: what follows the last sample.
    """

    times_s: F64
    places: F64
    wrap: Wrap

    def at(self, t_s: float) -> F64:
        """Return the position (3,) at `t_s`, linear between samples."""
        i, j, fraction = bracket(self.times_s, wrapped_time(t_s, float(self.times_s[-1]), self.wrap))
        return np.asarray(self.places[i] + (self.places[j] - self.places[i]) * fraction)


def way_of(mover: Mover, body: ShapedBody) -> Way:
    """Return the smoothed way of the pelvis of `mover`, whose body is `body`."""
    motion = mover.motion
    count = min(int(np.ceil(motion.duration_s / STEP_S)), MOST_SAMPLES - 1) + 1
    times = np.linspace(0.0, motion.duration_s, count)
    pelvises = motion.sample_all(times)[1] * mover.scale + mover.shift + body.joints[0]
    places = pelvises @ mover.world[:3, :3].T + mover.world[:3, 3]
    places[:, 1] = 0.0
    return Way(times, smoothed(places, float(times[-1]) / max(count - 1, 1), motion.wrap), motion.wrap)


def smoothed(places: F64, step_s: float, wrap: Wrap) -> F64:
    """Return `places` (T, 3), sampled every `step_s`, smoothed by a Gaussian. `wrap`: what follows the last sample."""
    if len(places) == 1:
        return places
    reach = int(np.ceil(ENDS_AFTER * SMOOTH_S / step_s))
    weights = np.exp(-0.5 * (np.arange(-reach, reach + 1) * step_s / SMOOTH_S) ** 2)
    weights /= weights.sum()
    # The last sample of a loop is the first sample of the next cycle.
    own = places[:-1] if wrap is Wrap.LOOP else places
    padded = np.pad(own, ((reach, reach), (0, 0)), mode=PADDING[wrap])  # type: ignore[call-overload]
    smooth = np.stack([np.convolve(column, weights, mode="valid") for column in padded.T], axis=1)
    return np.concatenate([smooth, smooth[:1]]) if wrap is Wrap.LOOP else smooth


@dataclass(frozen=True)
class PlacedCamera:
    """A camera in the scene.

    `path`: path of the camera, in its own world.
    `turn` (3, 3), `shift` (3,), metres: a point p of the path's world is at `turn @ p + shift` in the scene's world.
    `mount` (3, 3): rotation from the placed camera's axes to the axes of the camera in `path`; a constant tilt.
    `notes`: what was decided, for people.
    `ways`: smoothed paths of the avatars over the floor. The camera moves by their mean. Empty if the camera does not
    go along.
    """

    path: CameraPath
    turn: F64
    shift: F64
    mount: F64
    notes: tuple[str, ...]
    ways: tuple[Way, ...] = ()

    def sample(self, t_s: float) -> F64:
        """Return the transform (4, 4) from the scene's world to the camera at `t_s`."""
        turn, place = self.path.pose(t_s)
        at = self.turn @ place + self.shift
        if self.ways:
            at = at + np.mean([way.at(t_s) for way in self.ways], axis=0)
        return view_from_pose(self.turn @ turn @ self.mount, at)

    def reach(self) -> tuple[F64, F64]:
        """Return (lower, upper) bounds (3,) on the camera's coordinates in the scene, metres, at all times."""
        places = self.path.places @ self.turn.T + self.shift
        low, high = places.min(axis=0), places.max(axis=0)
        if self.ways:
            own = np.concatenate([way.places for way in self.ways])
            low, high = np.minimum(low, 0) + own.min(axis=0), np.maximum(high, 0) + own.max(axis=0)
        return low, high

    def projection(self, t_s: float, output: Shape) -> F64:
        """Return the OpenGL clip matrix (4, 4) at `t_s` for a picture of `output` (height, width)."""
        return self.path.projection(t_s, output)


LOWEST_DEG, HIGHEST_DEG = -8.0, 85.0
LEAST_LEVEL_M = 1e-6  # a camera is over the pivot if its horizontal distance, metres, is below this


def steered(view: F64, pivot: F64, azimuth_deg: float, elevation_deg: float, zoom: float) -> F64:
    """Return `view` after the camera is turned about `pivot` (3,) and moved towards it.

    `view` and the result: transform (4, 4) from world to camera.
    `azimuth_deg`: angle by which the camera moves to its right round the pivot, degrees.
    `elevation_deg`: angle by which the camera moves up, degrees; limited as in `_turn`.
    `zoom`: factor by which the distance to the pivot is divided, above 0.
    """
    if azimuth_deg == 0.0 and elevation_deg == 0.0 and zoom == 1.0:
        return view
    eye = -view[:3, :3].T @ view[:3, 3]
    turn = _turn(eye - pivot, azimuth_deg, elevation_deg)
    world = np.eye(4)
    world[:3, :3] = turn.T
    world[:3, 3] = pivot - turn.T @ pivot
    moved: F64 = view @ world
    seen = moved[:3, :3] @ pivot + moved[:3, 3]
    moved[:3, 3] += (1.0 / zoom - 1.0) * seen
    return moved


def _turn(arm: F64, azimuth_deg: float, elevation_deg: float) -> F64:
    """Return the rotation (3, 3) that steers a camera at `arm` (3,) from the pivot. Angles are as in `steered`.

    The elevation stays between LOWEST_DEG and HIGHEST_DEG. If the camera's own elevation is outside this range, the
    range is widened to it.
    """
    level = float(np.hypot(arm[0], arm[2]))
    if level < LEAST_LEVEL_M:
        return about(1, np.radians(azimuth_deg))
    heading = np.arctan2(arm[0], arm[2])
    now_deg = float(np.degrees(np.arctan2(arm[1], level)))
    low, high = min(LOWEST_DEG, now_deg), max(HIGHEST_DEG, now_deg)
    raised = np.radians(np.clip(now_deg + elevation_deg, low, high) - now_deg)
    return about(1, heading + np.radians(azimuth_deg)) @ about(0, -raised) @ about(1, -heading)


#: Range of the camera's median line of sight, degrees above the horizon. A camera outside is tilted to the nearer end,
#: by at most LARGEST_TILT_DEG.
SIGHT_DEG = (-24.0, 0.0)
LARGEST_TILT_DEG = 40.0
#: The far clip plane is at this multiple of the farthest distance that a body can have from the camera.
BEYOND = 1.1
#: A built-in camera is judged at moments this far apart, seconds, or at this many in a longer cycle.
JUDGED_EVERY_S, MOST_JUDGED = 0.25, 480
#: A built-in camera that always shows somebody goes along only if the mean visible share of the bodies grows by this.
LEAST_GAIN = 0.02


def place_camera(path: CameraPath, scene: Scene, movers: Sequence[Mover], bodies: Sequence[ShapedBody]) -> PlacedCamera:
    """Return the camera of `scene`, in its place. A recorded camera is set down where it films the avatars.

    A built-in camera goes along with the avatars if they would leave its picture otherwise. If `scene.camera.place` is
    `none`, the camera stays where it is.
    `path`: path of the camera.
    `scene`: its background, picture size and camera keys are used.
    `movers`: avatars of the scene. `bodies`: their bodies, in the same order.
    """
    if path.recorded and scene.camera.place == "auto":
        return _placed(path, scene, movers, bodies)
    camera = PlacedCamera(path, np.eye(3), np.zeros(3), np.eye(3), ())
    return camera if scene.camera.place == "none" else _going_along(camera, scene, movers, bodies)


def _going_along(
    camera: PlacedCamera, scene: Scene, movers: Sequence[Mover], bodies: Sequence[ShapedBody]
) -> PlacedCamera:
    """Return the built-in `camera`, made to go along with people if they would leave its picture otherwise.

    The camera is judged over one cycle of camera and motions: by whole bodies, or by heads for a close-up. It stays
    where it is if going along would show fewer whole bodies or heads, or would change little.
    """
    ways = tuple(way_of(mover, body) for mover, body in zip(movers, bodies, strict=True))
    times = _judged(camera.path, movers, ways)
    output = (scene.output.height, scene.output.width)
    what, joints = ("head", HEAD) if camera.path.is_closeup else ("body", JOINT_NAMES)
    stays = seen_at(times, camera, movers, bodies, output, joints)
    if stays.whole.all():
        return camera
    along = replace(camera, ways=ways)
    goes = seen_at(times, along, movers, bodies, output, joints)
    if goes.nobody.sum() >= stays.nobody.sum() and goes.share.mean() - stays.share.mean() < LEAST_GAIN:
        return camera
    if goes.whole.sum() < stays.whole.sum():
        note = (
            f"does not go along with the person over the floor: whole {what} in the picture in {stays.whole.mean():.0%}"
        )
        return replace(camera, notes=(f"{note} of the time; along with the person in {goes.whole.mean():.0%}",))
    note = f"goes along with the person over the floor: whole {what} in the picture in {goes.whole.mean():.0%}"
    lost = f", and no part of it in {stays.nobody.mean():.0%}" if stays.nobody.any() else ""
    return replace(along, notes=(f"{note} of the time; without that in {stays.whole.mean():.0%}{lost}",))


def _judged(path: CameraPath, movers: Sequence[Mover], ways: Sequence[Way]) -> F64:
    """Return the moments (F,), seconds, at which a built-in camera is judged.

    The moments cover one cycle, and contain the moment at which each way is farthest from the origin. If a motion holds
    its end, one cycle of the camera after that end is covered too.
    """
    cycles = (
        mover.motion.duration_s * (2 if mover.motion.wrap is Wrap.BOUNCE else 1)
        + path.duration_s * (mover.motion.wrap is Wrap.HOLD)
        for mover in movers
    )
    cycle_s = max(path.duration_s, JUDGED_EVERY_S, *cycles)
    even = np.arange(0.0, cycle_s, max(JUDGED_EVERY_S, cycle_s / MOST_JUDGED))
    farthest = [way.times_s[np.linalg.norm(way.places, axis=1).argmax()] for way in ways]
    return np.unique([*even, *farthest])


def _placed(path: CameraPath, scene: Scene, movers: Sequence[Mover], bodies: Sequence[ShapedBody]) -> PlacedCamera:
    """Return the recorded camera of `path` at its best place in `scene`."""
    times = np.linspace(0.0, SCORED_S, SCORED_MOMENTS)
    levelled, level, middle = _from_the_middle(path)
    output = (scene.output.height, scene.output.width)
    points = outermost_points(times, movers, bodies)
    tilts = [_tilt_deg(path, times), 0.0] if scene.background == ROOM else [0.0]
    found = []
    for tilt in dict.fromkeys(tilts):
        mount = about(0, np.radians(tilt))
        film = filming(levelled, mount, times, output, points, scene.camera.near_m)
        best, score = best_place(film)
        found.append((score, tilt, mount, film, best))
    _, tilt, mount, film, best = max(found, key=lambda one: one[0])
    turn = about(1, -facing(film, best[None])[0])
    shift = -turn @ best
    far_m, far_notes = _far(levelled.places, points @ turn + best, scene.camera)
    away = float(np.hypot(film.eyes[:, 0] - best[0], film.eyes[:, 2] - best[2]).mean())
    notes = (
        *((f"camera tilted by {tilt:+.0f} degrees on its mount",) if round(tilt) else ()),
        f"camera set down {away:.1f} m from the avatar, {film.eyes[:, 1].mean() - best[1]:.1f} m over the floor on "
        "average",
        *far_notes,
    )
    seeing = replace(path, optics=replace(path.optics, far_m=far_m))
    return PlacedCamera(seeing, turn @ level, shift - turn @ level @ middle, mount, notes)


def _far(places: F64, points: F64, spec: CameraSpec) -> tuple[float, tuple[str, ...]]:
    """Return (distance of the far clip plane, metres, beyond all `points` (F, P, 3); a note if it is increased)."""
    corners = points.reshape(-1, 3)
    low, high = np.minimum(places.min(axis=0), corners.min(axis=0)), np.maximum(places.max(axis=0), corners.max(axis=0))
    needed = min(BEYOND * float(np.linalg.norm(high - low)), MAX_DEPTH_RATIO * spec.near_m)
    if needed <= spec.far_m:
        return spec.far_m, ()
    return needed, (f"far clip plane at {needed:.0f} m in place of {spec.far_m:g} m, beyond the body",)


def _from_the_middle(path: CameraPath) -> tuple[CameraPath, F64, F64]:
    """Return (path, rotation, middle): `path` moved to have its middle at the origin and to look along -Z at first.

    The movement is new = rotation @ (old - middle), with a rotation (3, 3) about the vertical and the middle (3,). This
    makes the search for a place independent of the origin and the heading of the file's world.
    """
    ahead = path.pose(0.0)[0][:, 2]
    level = about(1, -np.arctan2(ahead[0], ahead[2]))
    middle = path.places.mean(axis=0)
    turned = quat_multiply(quat_from_matrix(level), path.quats)
    return replace(path, quats=turned, places=(path.places - middle) @ level.T), level, middle


def _tilt_deg(path: CameraPath, times: F64) -> float:
    """Return the angle, degrees, by which the camera is tilted up to bring its median line of sight into SIGHT_DEG."""
    sight = float(np.median([np.degrees(np.arcsin(np.clip(-path.pose(float(t))[0][1, 2], -1, 1))) for t in times]))
    return float(np.clip(np.clip(sight, *SIGHT_DEG) - sight, -LARGEST_TILT_DEG, LARGEST_TILT_DEG))
