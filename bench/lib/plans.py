"""The plans that `trilane bench planner` compares. Rule: the same scene, avatars and units; only the work differs."""

from __future__ import annotations

from trilane.stages.configure import Checked

#: Tensor of the reference application, which fills it in every frame.
FIXED = "512x512"


def fixed(checked: Checked) -> Checked:
    """The reference application's plan: one square tensor for everything, and every skin weight (12 at most)."""
    scene = checked.config.scene.model_copy(update={"size": FIXED, "plan": "fixed"})
    return checked.changed(scene=scene, shapes=())


def planned(checked: Checked) -> Checked:
    """What the scene says itself; the shapes of a planned tensor are in the configuration."""
    return checked


def in_frames(checked: Checked, frames: int) -> Checked:
    """The whole of the scene in `frames` frames: fewer, at longer steps. Unchanged when it has no more than those."""
    scene = checked.config.scene
    if frames >= scene.frames:
        return checked
    fewer = {"frames": frames, "fps": scene.fps * frames / scene.frames}
    return checked.changed(scene=scene.model_copy(update=fewer))
