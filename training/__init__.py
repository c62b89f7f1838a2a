"""How an avatar is made: ground truth, the training itself (with PyTorch, an optional extra) and quantisation.

It may use `stages/` and the folders below it.
"""
