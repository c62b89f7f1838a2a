"""An avatar on disk: its manifest, its body, its neural texture and its integer network.

This folder may import `pipeline/` and the folders below that; so far it needs `body/` and the modules in `src/trilane`.
"""
