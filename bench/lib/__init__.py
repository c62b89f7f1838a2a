"""Parts that several benches share: fixtures, networks, load patterns and clocks.

It may use what bench/ may, but no module of bench/ itself.
"""
