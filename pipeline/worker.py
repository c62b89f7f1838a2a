"""The process of a unit: `python -P -m trilane.pipeline.worker --unit UNIT --spec FD`.

Rule: first the ties (die with the parent, stay on the given cores), then, and only then, the heavy imports.
"""

from __future__ import annotations

import argparse
import ctypes
import json
import os
import signal
import sys
from typing import Any

PR_SET_PDEATHSIG = 1  # <linux/prctl.h>


def die_with_parent(parent_pid: int) -> None:
    """SIGKILL this process when the one that started it ends, also when it has ended already."""
    libc = ctypes.CDLL(None, use_errno=True)
    if libc.prctl(PR_SET_PDEATHSIG, signal.SIGKILL, 0, 0, 0) != 0:
        raise OSError(ctypes.get_errno(), "prctl(PR_SET_PDEATHSIG)")
    if os.getppid() != parent_pid:
        os._exit(1)


def read_spec(fd: int) -> dict[str, Any]:
    """The JSON document in the memory file `fd`."""
    size = os.fstat(fd).st_size
    spec: dict[str, Any] = json.loads(os.pread(fd, size, 0))
    os.close(fd)
    return spec


def main() -> int:
    parser = argparse.ArgumentParser(description="A unit of Trilane; started by a run, not by hand.")
    parser.add_argument("--unit", required=True)
    parser.add_argument("--spec", type=int, required=True)
    args = parser.parse_args()
    spec = read_spec(args.spec)
    die_with_parent(spec["parent_pid"])
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    os.sched_setaffinity(0, spec["config"]["units"][args.unit]["cores"])

    from trilane.pipeline.unit_loop import serve

    return serve(args.unit, spec)


if __name__ == "__main__":
    sys.exit(main())
