"""The body's mathematics in the SMPL-X layout: the body file, joints, kinematics, pose blend shapes and skinning.

It may use `transport/` and the modules in `src/trilane`, and needs no package but NumPy.
"""
