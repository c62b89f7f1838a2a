"""An avatar on disk: its manifest, its body, its neural texture and its integer network.

It may use `pipeline/` and the folders below it; so far it needs only the modules in `src/trilane`.
"""
