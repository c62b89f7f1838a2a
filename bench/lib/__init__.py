"""Parts that several benches share: fixtures, networks, reference pictures, and processes for variants.

This folder may import what bench/ may import, but no module of bench/ itself.
"""
