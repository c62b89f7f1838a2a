"""What an avatar's pictures depend on, as digests: the bytes of its files and the numbers of its manifest.

Rule: a byte that changes the picture changes a digest; names, provenance and other words change none.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from trilane.avatars.manifest import Digests, Manifest, Validation
from trilane.avatars.network_file import network_files
from trilane.errors import BadInputError

BLOCK = 1 << 20


def digests_of(folder: Path, manifest: Manifest) -> Digests:
    """The digests of the files in `folder` that `manifest` names. Raises BadInputError for one that cannot be read."""
    return Digests(
        body=sha256_of([folder / file for file in (manifest.body, manifest.offsets) if file is not None]),
        texture=sha256_of([folder / manifest.texture]),
        network=sha256_of(network_files(folder / manifest.network.file)),
        constants=hashlib.sha256(_constants(manifest).encode()).hexdigest(),
    )


def figures_digest(validation: Validation) -> str:
    """SHA-256, hexadecimal, of all that `validation` says but this digest, written in one way.

    A key that is None counts as not there, so an optional key that a later Trilane adds changes no older digest.
    """
    said = validation.model_dump(mode="json", exclude={"figures_digest"})
    return hashlib.sha256(_in_one_way(said).encode()).hexdigest()


def with_figures_digest(validation: Validation) -> Validation:
    """`validation`, which has just been measured, with the digest of its figures."""
    return validation.model_copy(update={"figures_digest": figures_digest(validation)})


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
    return _in_one_way(numbers)


def _in_one_way(values: dict[str, Any]) -> str:
    return json.dumps(values, sort_keys=True, separators=(",", ":"))
