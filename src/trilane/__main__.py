"""The command `trilane`, also as `python -m trilane`."""

from __future__ import annotations

import signal
from typing import NoReturn


def entry() -> NoReturn:
    """Run the command line. During the imports, Ctrl-C ends the process at once, without a traceback."""
    handler = signal.getsignal(signal.SIGINT)
    if handler is signal.default_int_handler:  # a shell's background job ignores SIGINT
        signal.signal(signal.SIGINT, signal.SIG_DFL)
    from trilane.apps.cli import main

    signal.signal(signal.SIGINT, handler)
    main.entry()


if __name__ == "__main__":
    entry()
