"""`python -m trilane` is the command `trilane`."""

from trilane.apps.cli.main import entry

entry()
