"""The avatar's stages, one folder per unit, and what joins them: packets, assets, configuration, the avatar's pipeline.

It may use `scene/`, `avatars/`, `hw_profiles/`, `pipeline/` and the folders below them.
"""
