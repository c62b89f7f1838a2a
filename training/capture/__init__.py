"""Captures: frames of one person on disk, with masks, body fits and the camera, from which an avatar is trained.

This folder may import those modules of `training/` that need no PyTorch.
"""
