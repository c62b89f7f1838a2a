"""The stages of a pipeline file: blocks, networks and own code, each with arrays as its ports.

Each module has one factory, `build`. What a block needs of the file is in `trilane.pipeline.file_keys`.
"""
