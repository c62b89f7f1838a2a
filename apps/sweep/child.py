"""The process of a trial: `python -m trilane.apps.sweep.child PARENT MODULE WORD...`, which only Trilane starts.

Rule: this process runs MODULE with the WORDs as its command line. PARENT is the id of its parent process. When the
parent ends, the kernel ends this process with SIGTERM.
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
