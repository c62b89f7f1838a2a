"""`trilane inspect`: what a file is, what was detected in it, and what to do if it is not usable.

Rule: this module shows what `trilane.apps.inspect` found; nothing is decided here.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Annotated, Any

import typer

from trilane.apps.cli.commands import Commands, JsonOption
from trilane.apps.cli.console import print_json, spinner, stderr_console, stdout_console, without_controls

app = Commands()

EPILOG = """\b
Examples:
  trilane inspect walk.bvh
  trilane inspect walk.bvh --out sheet.png
  trilane inspect transforms.json --json

\b
Exit codes:
  0 usable, 2 not usable or no such file
"""
UNUSABLE = 2
MOST_JOINTS = 60

FileArgument = Annotated[
    Path, typer.Argument(help="A motion, camera, picture, video, body, avatar, network, scene, trace or run.")
]
SheetOption = Annotated[Path | None, typer.Option("--out", help="Draw a contact sheet here (.png).")]


@app.command(epilog=EPILOG)
def inspect(file: FileArgument, out: SheetOption = None, json: JsonOption = False) -> None:
    """Say what a file or folder is: format, axes, unit, rate, length, joints; and what to do if it is not usable.

    Nothing is run. The sheet shows a skeleton or the path of a camera from three sides, or pictures.
    """
    from trilane.apps.inspect.inspect_file import inspect_file
    from trilane.errors import BadInputError
    from trilane.writing import require_writable

    if out is not None:
        if out.suffix.lower() != ".png":
            raise BadInputError("--out", f"'{out}'", "a name that ends in .png")
        require_writable(out)
    with spinner("reading"):
        found = inspect_file(file)
        sheet = _draw(found, out)
    document = found.document(file, sheet)
    if json:
        print_json(document)
    else:
        for line in lines(without_controls(document)):
            stdout_console().print(line, soft_wrap=True, markup=False)
    if out is not None and sheet is None:
        stderr_console().print(f"no sheet: nothing to draw of {document['what']}", soft_wrap=True, markup=False)
    if not found.usable:
        raise typer.Exit(UNUSABLE)


def _draw(found: Any, out: Path | None) -> Path | None:
    """Write the sheet and return its place; None where there is nothing to draw or nowhere to draw it."""
    from trilane.writing import write_atomically

    if out is None or found.draw is None:
        return None
    picture = found.draw()
    with write_atomically(out) as draft:
        picture.save(draft, format="PNG")
    return out


def lines(document: Mapping[str, Any]) -> Iterator[str]:
    """Yield the document as lines for people."""
    yield f"{document['file']}: {document['what']}"
    rows = {
        "not usable": document["problem"],
        "format": _because(document["detected"]["format"], document["detected"]["reason"]),
        **{key: document["detected"][key] for key in ("axes", "unit", "rate", "lens")},
        "length": _length(document["length"]),
        **_joints(document["joints"]),
        **{key.replace("_", " "): "" if value is None else str(value) for key, value in document["facts"].items()},
    }
    for key, value in rows.items():
        if value:
            yield f"  {key}: {value}"
    for note in document["notes"]:
        yield f"  note: {note}"
    if document["sheet"]:
        yield f"  sheet: {document['sheet']}"
    if document["advice"]:
        yield f"  {'what to do' if document['problem'] else 'use'}: {document['advice']}"


def _because(what: str, why: str) -> str:
    return f"{what}, detected by {why}" if what and why else what


def _length(length: Mapping[str, Any]) -> str:
    if length["samples"] is None:
        return ""
    rate = f" at {length['rate_hz']:.4g}/s" if length["rate_hz"] else ""
    return f"{length['samples']} samples{rate}, {length['seconds']:.2f} s"


def _joints(joints: Mapping[str, Any]) -> dict[str, str]:
    pairs = [name if name == theirs else f"{name} = {theirs}" for name, theirs in joints["mapped"].items()]
    return {
        "joints mapped": _listed(pairs),
        "joints of the file without a partner": _listed(joints["unmapped"]),
        "body joints that the file does not have": _listed(joints["missing"]),
    }


def _listed(names: list[str]) -> str:
    more = f" and {len(names) - MOST_JOINTS} more" if len(names) > MOST_JOINTS else ""
    return f"{len(names)}: {', '.join(names[:MOST_JOINTS])}{more}" if names else ""
