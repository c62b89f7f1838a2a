"""Measurements of this machine: one module per question, each answered by its `measure`, and `lib/` for what they share.

It may use every folder but apps/.
"""
