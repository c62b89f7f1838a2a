"""Content of the pictures: scene files, motions and cameras, and how a scene is staged from them.

It may use `pipeline/` and the layers below it; so far it needs `body/` and the modules in `src/trilane`.
"""
