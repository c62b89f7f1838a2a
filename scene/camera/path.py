"""A camera over time, from any source: poses at increasing times, their lenses, and the built-in cameras.

A pose is a transform from camera to world, with OpenGL axes (x right, y up, looks along -Z) and world Y up. Between
samples, position and lens are interpolated linearly, the rotation by slerp. After the last sample, the path loops or
runs backwards (`wrap`). A built-in camera is a formula of time for a person at the origin who faces +Z, sampled over
one cycle.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from trilane.arrays import F64, Shape
from trilane.scene.lens import Lens, of_fov_y
from trilane.scene.motion.motion import Wrap, bracket, wrapped_time
from trilane.scene.recordings import NOTHING, Detected
from trilane.scene.rotations import matrix_from_quat, quat_from_matrix, slerp
from trilane.scene.schema import CameraSpec

ROUNDING_S = 1e-6
HALFWAY = 0.5


def view_from_pose(turn: F64, place: F64) -> F64:
    """Return the transform (4, 4) from world to camera.

    `turn` (3, 3): axes of the camera as columns. `place` (3,): position of the camera.
    """
    view = np.eye(4)
    view[:3, :3] = turn.T
    view[:3, 3] = -turn.T @ place
    return view


def look_at(place: F64, target: F64) -> F64:
    """Return the transform (4, 4) from world to a level camera at `place` (3,) that looks at `target` (3,).

    The camera must not look straight up or down.
    """
    return view_from_pose(axes_towards(place[None], target)[0], place)


def axes_towards(places: F64, target: F64) -> F64:
    """Return the axes, as columns (N, 3, 3), of level cameras at `places` (N, 3) that look at `target` (3,)."""
    back = _unit_rows(places - target)
    right = _unit_rows(np.cross([0.0, 1.0, 0.0], back))
    return np.stack([right, np.cross(back, right), back], axis=-1)


def _unit_rows(vectors: F64) -> F64:
    lengths = [np.linalg.norm(vector) for vector in vectors]
    return np.asarray(vectors / np.array(lengths)[:, None])


def projection_matrix(fov_y_deg: float, aspect: float, near_m: float, far_m: float) -> F64:
    """Return an OpenGL perspective matrix (4, 4).

    `fov_y_deg`: field of view over the picture's height, degrees.
    `aspect`: width over height.
    `near_m`, `far_m`: distances of the clip planes, metres.
    """
    f = 1 / np.tan(np.radians(fov_y_deg) / 2)
    depth = near_m - far_m
    return np.array(
        [
            [f / aspect, 0.0, 0.0, 0.0],
            [0.0, f, 0.0, 0.0],
            [0.0, 0.0, (far_m + near_m) / depth, 2 * far_m * near_m / depth],
            [0.0, 0.0, -1.0, 0.0],
        ]
    )


@dataclass(frozen=True)
class Optics:
    """The lenses of a camera path, and the pictures that they made.

    `lenses`: one lens for all samples of the path, or one for each.
    `near_m`, `far_m`: distances of the clip planes, metres.
    `filmed`: (height, width) of the background that the camera filmed, as it is shown; one for all samples or one for
    each. The tuple is empty if the camera did not film the background.
    `turned`: number of quarter turns clockwise applied to the background's pixels before they are shown; one for all
    samples or one for each. The tuple is empty if each picture is turned as its own file prescribes.
    """

    lenses: tuple[Lens, ...]
    near_m: float
    far_m: float
    filmed: tuple[Shape, ...] = ()
    turned: tuple[int, ...] = ()

    def lens(self, i: int, j: int, fraction: float, output: Shape) -> Lens:
        """Return the lens for a picture of `output` (height, width), a `fraction` of the way from sample `i` to `j`.

        If the camera filmed the background, its picture is cut in the same way as the background. Otherwise the picture
        keeps the vertical field of view of the camera.
        """
        first = self._shown(i, output)
        is_one = len(self.lenses) == 1 and len(self.filmed) <= 1
        return first if is_one else first.between(self._shown(j, output), fraction)

    def _shown(self, sample: int, output: Shape) -> Lens:
        lens = self.lenses[sample % len(self.lenses)]
        if not self.filmed:
            return lens.filling_height(output)
        return lens.onto(self.filmed[sample % len(self.filmed)]).covering(output)


def one_lens(fov_y_deg: float, near_m: float, far_m: float) -> Optics:
    """Return optics with one lens for all samples.

    `fov_y_deg`: field of view over the picture's height, degrees. `near_m`, `far_m`: distances of the clip planes,
    metres.
    """
    return Optics((of_fov_y(fov_y_deg),), near_m, far_m)


@dataclass(frozen=True)
class CameraPath:
    """A camera over time.

    `times_s` (N,): times from 0, strictly increasing.
    `quats` (N, 4), `places` (N, 3): rotations and positions, from camera to world, metres.
    `optics`: lenses of the samples.
    `notes`: how the source was read, for people.
    `wrap`: what follows the last sample: the path loops or runs backwards.
    `recorded`: whether the path comes from a recording, which has to be placed in the scene.
    `detected`: facts about the camera's file.
    `pictures`: name of the photo of each sample; empty if the file names none.
    `quarter`: number of quarter turns clockwise that were applied to the camera's picture.
    `is_held`: whether each sample holds until halfway to its neighbours, as its photo does.
    `repeat_s`: time after which the path starts again, as its background does; 0 if only `wrap` counts.
    `began_s`: time 0 in seconds since 1970; None if the file does not state it.
    `is_closeup`: whether the camera is made for a head, not for a whole body.
    """

    times_s: F64
    quats: F64
    places: F64
    optics: Optics
    notes: tuple[str, ...]
    wrap: Wrap = Wrap.BOUNCE
    recorded: bool = True
    detected: Detected = NOTHING
    pictures: tuple[str, ...] = ()
    quarter: int = 0
    is_held: bool = False
    repeat_s: float = 0.0
    began_s: float | None = None
    is_closeup: bool = False

    @property
    def duration_s(self) -> float:
        """Time of the last sample, seconds."""
        return float(self.times_s[-1])

    @property
    def course(self) -> str:
        """Duration of the path and what follows it, for people."""
        if len(self.times_s) == 1:
            return "one pose: held"
        then = "starts again with the background" if self.repeat_s else self.wrap.value
        return f"{self.duration_s:.2f} s, then {then}"

    def pose(self, t_s: float) -> tuple[F64, F64]:
        """Return the rotation (3, 3) and the position (3,) of the camera at `t_s`, from camera to world."""
        i, j, fraction = self._between(t_s)
        turn = matrix_from_quat(slerp(self.quats[i], self.quats[j], fraction))
        return turn, self.places[i] + (self.places[j] - self.places[i]) * fraction

    def nearest(self, t_s: float) -> int:
        """Return the index of the sample nearest to the time `t_s`, seconds."""
        i, j, fraction = self._bracket(t_s)
        return i if fraction < HALFWAY else j

    def _between(self, t_s: float) -> tuple[int, int, float]:
        """Return (i, j, share): the samples between which the pose at `t_s` lies, and its share of the way from i to j.

        The share is from 0 to 1. If samples are held, i and j are the nearest sample.
        """
        if not self.is_held:
            return self._bracket(t_s)
        held = self.nearest(t_s)
        return held, held, 0.0

    def _bracket(self, t_s: float) -> tuple[int, int, float]:
        if self.repeat_s:
            t_s = max((t_s + ROUNDING_S) % self.repeat_s - ROUNDING_S, 0.0)
        return bracket(self.times_s, wrapped_time(t_s, self.duration_s, self.wrap))

    def sample(self, t_s: float) -> F64:
        """Return the transform (4, 4) from world to camera at `t_s`."""
        return view_from_pose(*self.pose(t_s))

    def own_lens(self, t_s: float) -> Lens:
        """Return the lens at `t_s` in pixels of the picture that the camera took."""
        i, j, fraction = self._between(t_s)
        lenses = self.optics.lenses
        return lenses[i % len(lenses)].between(lenses[j % len(lenses)], fraction) if len(lenses) > 1 else lenses[0]

    def lens(self, t_s: float, output: Shape) -> Lens:
        """Return the lens at `t_s` for a picture of `output` (height, width)."""
        return self.optics.lens(*self._between(t_s), output)

    def projection(self, t_s: float, output: Shape) -> F64:
        """Return the OpenGL clip matrix (4, 4) at `t_s` for a picture of `output` (height, width)."""
        return self.lens(t_s, output).projection(self.optics.near_m, self.optics.far_m)


FOV_Y_DEG = 40.0
RATE_HZ = 30
HEAD_AND_SHOULDERS = "head and shoulders"


@dataclass(frozen=True)
class Orbit:
    """A camera that swings by `swing_deg` to either side around `target`, and moves from `far_m` to `near_m` and back.

    `what`: description for people. `target`: point (x, y, z) on the Y axis, metres. `height_m`: height of the camera.
    `far_m`, `near_m`: horizontal distances from the Y axis. `period_s`: duration of a cycle.
    """

    what: str
    target: tuple[float, float, float]
    height_m: float
    far_m: float
    near_m: float
    swing_deg: float
    period_s: float

    def places(self, phase: F64) -> F64:
        """Return positions (N, 3), metres, at `phase` (N,) of the cycle, radians."""
        angle = np.radians(self.swing_deg) * np.sin(phase - 0.6)
        distance = self.far_m + (self.near_m - self.far_m) * (1 - np.cos(phase)) / 2
        return np.column_stack([distance * np.sin(angle), np.full(len(phase), self.height_m), distance * np.cos(angle)])


@dataclass(frozen=True)
class Descent:
    """A camera that descends from the elevation `top_deg` over `target` to the height `low_m`, and rises again.

    It moves on an arc about `target` of radius `distance_m`, in the plane x = 0. `what`: description for people.
    `period_s`: duration of a cycle.
    """

    what: str
    target: tuple[float, float, float]
    distance_m: float
    top_deg: float
    low_m: float
    period_s: float

    def places(self, phase: F64) -> F64:
        """Return positions (N, 3), metres, at `phase` (N,), radians: the top at 0, the lowest point at pi."""
        top, low = np.radians(self.top_deg), np.arcsin((self.low_m - self.target[1]) / self.distance_m)
        angle = low + (top - low) * (1 + np.cos(phase)) / 2
        arc = np.column_stack([np.zeros(len(phase)), np.sin(angle), np.cos(angle)])
        return np.asarray(np.array(self.target) + self.distance_m * arc)


@dataclass(frozen=True)
class Stand:
    """A camera that stands at `place` and looks at `target`. `what`: description for people."""

    what: str
    target: tuple[float, float, float]
    place: tuple[float, float, float]
    period_s: float = 1.0

    def places(self, phase: F64) -> F64:
        """Return the camera's position, metres, repeated for each of `phase` (N,): (N, 3)."""
        return np.tile(self.place, (len(phase), 1))


#: Built-in cameras by name.
BUILTIN: dict[str, Orbit | Descent | Stand] = {
    "orbit": Orbit("whole person, going round, coming nearer", (0.0, 0.93, 0.0), 1.35, 3.9, 3.4, 28.0, 20.0),
    "static": Orbit("whole person, standing still", (0.0, 0.93, 0.0), 1.30, 3.8, 3.8, 0.0, 20.0),
    "closeup": Orbit(HEAD_AND_SHOULDERS, (0.0, 1.50, 0.0), 1.58, 1.15, 0.95, 16.0, 12.0),
    "far": Orbit("whole person, far off", (0.0, 1.00, 0.0), 1.60, 10.0, 8.0, 10.0, 20.0),
    "top-to-floor": Descent("whole person, from above down to the floor", (0.0, 0.90, 0.0), 3.9, 80.0, 0.12, 12.0),
    "wayside": Stand("beside the way of one who walks along z", (-0.1, 1.05, -2.5), (0.9, 1.45, 1.9)),
}


def load_builtin(name: str, spec: CameraSpec) -> CameraPath | None:
    """Return the built-in camera `name`; None if there is no such camera.

    `spec`: camera of the scene; only its field of view and its clip planes are used.
    """
    camera = BUILTIN.get(name)
    if camera is None:
        return None
    count = int(camera.period_s * RATE_HZ)
    times = np.arange(count + 1) / RATE_HZ
    places = camera.places(2 * np.pi * times / camera.period_s)
    fov = FOV_Y_DEG if spec.fov_y_deg is None else spec.fov_y_deg
    pace = "fixed" if isinstance(camera, Stand) else f"{camera.period_s:g} s a cycle"
    notes = (f"built in: {camera.what}, {pace}, field of view {fov:g} degrees high",)
    quats = quat_from_matrix(axes_towards(places, np.array(camera.target)))
    optics = one_lens(fov, spec.near_m, spec.far_m)
    return CameraPath(
        times, quats, places, optics, notes, Wrap.LOOP, recorded=False, is_closeup=camera.what == HEAD_AND_SHOULDERS
    )
