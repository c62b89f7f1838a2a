"""What an avatar's pictures depend on, as digests: the bytes of its files and the numbers of its manifest.

Rule: a byte that changes the picture changes a digest; names, provenance and other words change none.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Sequence
from pathlib import Path

from trilane.avatars.manifest import Digests, Manifest
from trilane.avatars.network_file import network_files
from trilane.errors import BadInputError

BLOCK = 1 << 20


def digests_of(folder: Path, manifest: Manifest) -> Digests:
    """The digests of the files in `folder` that `manifest` names. Raises BadInputError for one that cannot be read."""
    return Digests(
        body=sha256_of([folder / manifest.body]),
        texture=sha256_of([folder / manifest.texture]),
        network=sha256_of(network_files(folder / manifest.network.file)),
        constants=hashlib.sha256(_constants(manifest).encode()).hexdigest(),
    )


def sha256_of(files: Sequence[Path]) -> str:
    """SHA-256, hexadecimal, of the bytes of `files`, one after the other. Raises BadInputError."""
    digest = hashlib.sha256()
    for file in files:
        try:
            with file.open("rb") as stream:
                while block := stream.read(BLOCK):
                    digest.update(block)
        except OSError as error:
            raise BadInputError.of_os_error(file, error, "a readable file") from error
    return digest.hexdigest()


def _constants(manifest: Manifest) -> str:
    """The manifest's numbers that the picture depends on, written in one way."""
    network = manifest.network
    numbers = {
        "betas": list(manifest.betas),
        "expression": list(manifest.expression),
        "channels": network.channels,
        "input": network.input.model_dump(),
        "output": network.output.model_dump(),
    }
    return json.dumps(numbers, sort_keys=True, separators=(",", ":"))
