"""Parts that several benches share: fixtures, networks, reference pictures, and processes for variants.

This folder may import from the same folders as bench/, but from no module of bench/ outside of lib/.
"""
