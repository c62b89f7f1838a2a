"""An avatar on disk: its manifest, its body, its neural texture and its integer network.

It may use `pipeline/` and the layers below it; so far it needs `body/` and the modules in `src/trilane`.
"""
