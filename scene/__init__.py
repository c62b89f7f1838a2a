"""What is shown: scene files, motions and cameras, and how they are put together in one place.
Uses `body` and the modules beside the package's folders (`trilane.errors`, `trilane.files` and their like).
"""
