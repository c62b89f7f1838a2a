"""The process of a trial: `python -m trilane.apps.sweep.child PARENT MODULE WORD...`, started by Trilane alone.

Rule: this process runs MODULE with WORDs. It ends, by a signal of the kernel, if its parent, the process PARENT, ends.
"""

from __future__ import annotations

import runpy
import signal
import sys

from trilane.pipeline.fork_server import die_with_parent


def main() -> None:
    parent, module, *words = sys.argv[1:]
    die_with_parent(int(parent), signal.SIGTERM)
    sys.argv = [module, *words]
    runpy.run_module(module, run_name="__main__", alter_sys=True)


if __name__ == "__main__":
    main()
