"""The body in the SMPL-X layout: body file, joints, kinematics, pose blend shapes and skinning.

It may use `transport/` and the modules in `src/trilane`, and needs no package but NumPy.
"""
