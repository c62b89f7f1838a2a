"""The camera of a scene: a camera path, moved to its place in the scene. Sampled once per frame.

Rule: the path itself is never changed; one turn, one shift and one tilt hold for all frames.
"""

from __future__ import annotations

from dataclasses import dataclass

from trilane.arrays import F64
from trilane.scene.camera.path import CameraPath, view_from_pose
from trilane.shapes import Shape


@dataclass(frozen=True)
class PlacedCamera:
    """A camera in the scene.

    `turn` (3, 3) and `shift` (3,): from the path's world to the scene's. `mount` (3, 3): from the camera's axes to
    those of the path. `notes`: what was decided, for people.
    """

    path: CameraPath
    turn: F64
    shift: F64
    mount: F64
    notes: tuple[str, ...]

    def sample(self, t_s: float) -> F64:
        """World to camera (4, 4) at `t_s`; the world is the scene's."""
        turn, place = self.path.pose(t_s)
        return view_from_pose(self.turn @ turn @ self.mount, self.turn @ place + self.shift)

    def reach(self) -> tuple[F64, F64]:
        """Lowest and highest coordinates (3,), in the scene, of the places that the camera is ever at."""
        places = self.path.places @ self.turn.T + self.shift
        return places.min(axis=0), places.max(axis=0)

    def projection(self, t_s: float, output: Shape) -> F64:
        """OpenGL clip matrix (4, 4) at `t_s` for a picture of `output` (height, width)."""
        return self.path.projection(t_s, output)
