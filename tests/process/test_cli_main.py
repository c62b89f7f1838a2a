"""The command line as a process: what it imports, `--debug`, colours, encodings and completion."""

from __future__ import annotations

import os
import subprocess
import sys

from trilane.apps.cli import doctor

HEAVY = ("numpy", "pydantic", "onnxruntime", "moderngl", "av", "rich.table")


def run_trilane(*arguments: str, **environment: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-m", "trilane.apps.cli.main", *arguments],
        capture_output=True,
        text=True,
        check=False,
        env={**os.environ, **environment},
    )


def test_help_imports_nothing_heavy() -> None:
    probe = f"""
import sys
from trilane.apps.cli.main import main
sys.argv = ["trilane", "--help"]
try:
    main()
except SystemExit:
    print([name for name in {HEAVY} if name in sys.modules], file=sys.stderr)
"""
    done = subprocess.run([sys.executable, "-c", probe], capture_output=True, text=True, check=False)
    assert done.stderr == "[]\n"


def test_debug_shows_the_traceback_wherever_it_stands() -> None:
    for arguments in (["--debug", "run", "nowhere"], ["run", "nowhere", "--debug"]):
        done = run_trilane(*arguments)
        assert "Traceback" in done.stderr
        assert "BadInputError" in done.stderr


def test_doctor_prints_a_table_without_colour_when_asked() -> None:
    done = run_trilane("doctor", NO_COLOR="1")
    assert done.returncode in (0, doctor.MISSING)
    assert "EGL and OpenGL" in done.stdout
    assert "\x1b[" not in done.stdout


def test_what_the_encoding_of_stdout_lacks_is_a_question_mark() -> None:
    """And so it is in a locale without one."""
    words = ("profiles", "show", "snapdragon-888")
    done, by_locale = run_trilane(*words, PYTHONIOENCODING="ascii"), run_trilane(*words)
    assert (done.returncode, done.stderr, by_locale.returncode, by_locale.stderr) == (0, "", 0, "")
    assert "| value    | ? % | kind" in done.stdout


def test_completion_knows_the_commands_and_their_options() -> None:
    found = {}
    for words, place in (("trilane ru", "1"), ("trilane run --pol", "2")):
        done = run_trilane(_TRILANE_COMPLETE="complete_bash", COMP_WORDS=words, COMP_CWORD=place)
        found[words] = done.stdout.split()
    assert found == {"trilane ru": ["run"], "trilane run --pol": ["--policy"]}
