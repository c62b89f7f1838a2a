"""What a bundle and a network are, as plain data for people and for JSON.

Rule: every figure is read from the files or from the manifest, which says how it was measured; the manifest's figures
are left out where the files are not those that were validated.
"""

from __future__ import annotations

from typing import Any

from trilane.avatars.bundle import Bundle
from trilane.avatars.network_file import NetworkFile
from trilane.avatars.validation import validation_facts
from trilane.errors import BadInputError
from trilane.hw_profiles.network_work import graph_facts


def bundle_facts(bundle: Bundle) -> dict[str, Any]:
    """The manifest's entries, sizes in bytes, and what the network's file holds. Raises BadInputError.

    Keys: `name`, `folder`, `files`, `body`, `texture`, `network`, `quantisation`, `provenance`, `training_command`,
    `validation`.
    """
    manifest = bundle.manifest
    shaped = bundle.shaped_body()
    files = {"body": bundle.body_path, "texture": bundle.texture_path, "network": bundle.network_path}
    files |= {"offsets": bundle.offsets_path} if bundle.offsets_path is not None else {}
    return {
        "name": manifest.name,
        "folder": str(bundle.folder),
        "files": {key: {"name": path.name, "bytes": path.stat().st_size} for key, path in files.items()},
        "body": {"vertices": len(shaped.vertices)},
        "texture": {"shape": list(bundle.read_texture().shape)},
        "network": {**manifest.network.model_dump(), **network_facts(bundle.read_network())},
        "quantisation": manifest.quantisation,
        "provenance": manifest.provenance,
        "training_command": manifest.training_command,
        "validation": validation_facts(bundle),
    }


def network_facts(network: NetworkFile) -> dict[str, Any]:
    """`shape` (N, H, W, C), `sha256`, and the work of one pass, see `graph_facts`. Raises BadInputError."""
    try:
        work = graph_facts(network.model)
    except BadInputError as error:
        raise BadInputError(f"{network.where}, {error.where}", error.found, error.expected, error.remedy) from None
    return {"shape": list(network.shape), "sha256": network.digest, **work}
