"""The clothes, hair and paint of the default body, which make the ground truth that avatars are trained on.

It may use `training/surface.py`, `stages/` and the folders below it.
"""
