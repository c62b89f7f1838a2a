"""SMPL-X mathematics: the body file, joints, kinematics, blend shapes and skinning.

It may use `transport/` and what lies below, and needs only NumPy.
"""
