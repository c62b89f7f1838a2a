"""Captures: frames of one person on disk, with masks, body fits and the camera, from which an avatar is trained.

It may use `training/clothing.py` and the modules of `training/` that need no PyTorch.
"""
