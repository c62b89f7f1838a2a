"""The command `trilane`, also as `python -m trilane`."""

from __future__ import annotations

import signal
from typing import NoReturn


def entry() -> NoReturn:
    """Run the command line. Ctrl-C ends it at once, without a traceback, until its modules are imported."""
    handler = signal.getsignal(signal.SIGINT)
    if handler is signal.default_int_handler:  # a background job of a shell ignores it
        signal.signal(signal.SIGINT, signal.SIG_DFL)
    from trilane.apps.cli import main

    signal.signal(signal.SIGINT, handler)
    main.entry()


if __name__ == "__main__":
    entry()
