"""Which job goes next: a pure core and its two drivers."""

from trilane.scheduler.compiled import form

form()
