"""Which job goes next: a pure core and its two drivers."""
