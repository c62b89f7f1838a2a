"""Numbers that are hard to get right: rotations, bodies, cameras, tensors, times; each with a bound.

Rule: a bound follows from the formulas that are computed and from the precision of the numbers, never from a result.
"""
