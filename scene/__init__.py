"""What is shown: scene files, motions and cameras, and how they are put together in one place.

It may use `pipeline/` and the folders below it; so far it needs `body/` and the modules in `src/trilane`.
"""
