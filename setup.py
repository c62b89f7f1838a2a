"""Compiles the modules that scheduler/compiled.py lists. Rule: where that fails the package is installed as Python.

mypyc is asked only by the commands that build something; the others would wait for it in vain.
"""

import runpy
import sys
from pathlib import Path

from setuptools import Extension, setup

PACKAGE = Path("src/trilane")
BUILDING = {"build_ext", "bdist_wheel", "editable_wheel"}


def compiled_modules() -> list[Extension]:
    from mypyc.build import mypycify

    names = runpy.run_path(str(PACKAGE / "scheduler" / "compiled.py"))
    for old in (*PACKAGE.parent.glob(f"{names['PREFIX']}*.so"), *PACKAGE.glob("*/*.so")):
        old.unlink()
    flags = ["--ignore-missing-imports", "--follow-imports=silent"]
    modules = [str(PACKAGE / name) for name in names["MODULES"]]
    try:
        found = mypycify([*flags, *modules], opt_level="2", debug_level="0", group_name=names["library"](PACKAGE))
    except SystemExit:  # so it ends when this mypy finds something to say about the sources
        print("mypyc cannot compile the scheduler (see above): it is installed as Python", file=sys.stderr)
        return []
    for extension in found:
        extension.optional = True
    return found


setup(ext_modules=compiled_modules() if BUILDING & set(sys.argv) else [])
