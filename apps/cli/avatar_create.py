"""`trilane avatar create`: an avatar of another one's files and some that a person brings.

Rule: this file talks to the person; the work is done in `trilane.apps.assembled_avatar`.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from trilane.apps.cli.console import print_facts
from trilane.apps.cli.options import JsonOption

EPILOG_CREATE = """\b
Examples:
  trilane avatar create --network mine.onnx --out mine
  trilane avatar create my-avatar --network entropy.onnx --out my-avatar-entropy
  trilane avatar create --network mine.onnx --texture texture.npz --body body.npz --out mine
"""


def create(
    out: Annotated[Path, typer.Option("--out", help="Folder of the avatar to write.")],
    name: Annotated[str, typer.Argument(help="The avatar whose other parts stay: its name or folder.")] = "default",
    network: Annotated[
        Path | None, typer.Option(help="Integer network (.onnx), as `trilane avatar quantise` writes it.")
    ] = None,
    texture: Annotated[
        Path | None, typer.Option(help="Neural texture (.npz): `texture` (H, W, C), with `scale` if it is int8.")
    ] = None,
    body: Annotated[Path | None, typer.Option(help="Body (.npz) in the SMPL-X layout, at its mean shape.")] = None,
    json: JsonOption = False,
) -> None:
    """Put another network, texture or body into an avatar, as a new one.

    To train an avatar of a person: docs/own-avatar.md.
    """
    from trilane.apps.assembled_avatar import Parts, assemble
    from trilane.avatars.bundle import load_bundle

    print_facts(assemble(load_bundle(name), Parts(network, texture, body), out), json)
