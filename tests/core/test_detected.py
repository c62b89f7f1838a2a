"""What readers say that they detected, as fields: format, axes, unit, rate, lens, joints with a partner and without."""

from __future__ import annotations

from pathlib import Path

from trilane.scene.camera.files import load_camera
from trilane.scene.motion.files import load_motion
from trilane.scene.schema import AvatarSpec, CameraSpec


def test_of_a_real_bvh(shared_data: Path) -> None:
    """Every joint of the file is named once: with its partner, or without one."""
    path = shared_data / "motion" / "cmu_jumping_jacks.bvh"
    found = load_motion(AvatarSpec(motion=str(path)), Path()).detected
    assert (found.format, found.rate, found.axes) == ("BVH", "by `Frame Time`", "Y up, as the body stands")
    assert found.reason.endswith("of MotionBuilder")
    assert found.unit.startswith("cmu")
    assert found.joints["left_knee"] == "LeftKnee"
    assert {"LHipJoint", "RHipJoint"} <= set(found.unmapped)
    named = [line.split()[1] for line in path.read_text().splitlines() if line.split()[:1] in (["JOINT"], ["ROOT"])]
    assert sorted((*found.joints.values(), *found.unmapped)) == sorted(named)


def test_of_real_poses_without_a_rate(shared_data: Path) -> None:
    path = shared_data / "motion" / "smplx_poses_8.npy"
    found = load_motion(AvatarSpec(motion=str(path)), Path()).detected
    assert found.format == "SMPL-X poses (.npy)"
    assert found.reason == "an array of shape (8, 165)"
    assert "taken for separate poses" in found.rate


def test_of_real_cameras(shared_data: Path) -> None:
    formats = {
        "arkit_camera_pose.txt": ("ARKit log", "13 columns"),
        "tum_freiburg1_xyz.txt": ("TUM trajectory", "column names"),
    }
    for name, (format_, reason) in formats.items():
        found = load_camera(CameraSpec(source=str(shared_data / "camera" / name)), Path()).detected
        assert found.format == format_
        assert found.reason.startswith(reason)
        assert found.rate.startswith("by the times of the file")
        assert found.axes and found.lens.startswith("field of view")


def test_what_is_built_in_has_no_file() -> None:
    assert not load_motion(AvatarSpec(motion="builtin:idle"), Path()).detected.format
    assert not load_camera(CameraSpec(source="builtin:orbit"), Path()).detected.format
