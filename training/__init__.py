"""How an avatar is made: ground truth, training (with PyTorch, an optional extra) and quantisation.

This folder may import `stages/` and every folder that `stages/` may import.
"""
