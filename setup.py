"""Compiles the modules that src/trilane/compiled.py lists. Rule: all of them, or the package is installed as Python.

mypyc is asked only by the commands that build something; the others would wait for it in vain.
"""

import contextlib
import runpy
import sys
from importlib.machinery import EXTENSION_SUFFIXES
from pathlib import Path

from setuptools import Extension, setup
from setuptools.command.build_ext import build_ext
from setuptools.errors import BaseError, CCompilerError

PACKAGE = Path("src/trilane")
BUILDING = {"build_ext", "bdist_wheel", "editable_wheel"}
IN_PLACE = {"build_ext", "editable_wheel"}
INTERPRETED = Path(".venv/interpreted")  # `make interpreted` was asked for
NAMES = runpy.run_path(str(PACKAGE / "compiled.py"))


class AllOrNothing(build_ext):
    """What a compiler that fails has built before is taken away again."""

    def run(self) -> None:
        try:
            super().run()
        except (CCompilerError, BaseError) as error:
            for built in self.get_outputs():
                Path(built).unlink(missing_ok=True)
            self.extensions = []
            print(f"not compiled: {error}; the scheduler is installed as Python", file=sys.stderr)


def remove_old() -> None:
    """What this Python compiled in place from other sources."""
    ending = EXTENSION_SUFFIXES[0]
    for old in (*PACKAGE.parent.glob(f"{NAMES['PREFIX']}*{ending}"), *PACKAGE.glob(f"*/*{ending}")):
        old.unlink()


def compiled_modules() -> list[Extension]:
    from mypyc.build import mypycify

    flags = ["--ignore-missing-imports", "--follow-imports=silent"]
    modules = [str(PACKAGE / name) for name in NAMES["MODULES"]]
    found: list[Extension] = []
    with contextlib.suppress(SystemExit):  # so it ends when this mypy finds something to say about the sources
        found = mypycify([*flags, *modules], opt_level="2", debug_level="0", group_name=NAMES["library"](PACKAGE))
    if not found:
        print("mypyc cannot compile the scheduler (see above): it is installed as Python", file=sys.stderr)
    return found


if IN_PLACE & set(sys.argv):
    remove_old()
builds = BUILDING & set(sys.argv) and not INTERPRETED.exists()
setup(ext_modules=compiled_modules() if builds else [], cmdclass={"build_ext": AllOrNothing})
