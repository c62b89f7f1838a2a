"""The stages of a pipeline file: blocks, networks and own code, each with arrays as its ports.

Each module has the factories of its stages. The keys of a block in the file are in `trilane.pipeline.file_keys`.
"""
