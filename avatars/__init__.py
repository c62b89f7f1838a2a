"""What an avatar is on disk: its manifest, its body, its neural texture and its integer network.

It may use `body/`, `transport/` and the modules in `src/trilane`.
"""
