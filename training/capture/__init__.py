"""Captures: frames of one person on disk, with masks, fits of the body and the camera, that an avatar is trained on.

It may use `training/clothing/` and the modules of `training/` that need no PyTorch.
"""
