"""Which job goes next: a pure core and its two drivers."""

from trilane.compiled import check

check()
