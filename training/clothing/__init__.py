"""The clothes, hair and paint of the default body, which make the ground truth that avatars are trained on.

It may use `stages/gpu/`, the modules of `training/` that it is given arrays by, and the folders below `stages/`.
"""
