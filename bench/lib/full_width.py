"""The full-width network of the paper as an avatar: the default avatar's body and texture around untrained weights.

Rule: only its work counts, its pictures mean nothing; it is made once and kept in the folder of compiled networks.
"""

from __future__ import annotations

import hashlib
from pathlib import Path

import numpy as np

from trilane.avatars.bundle import MANIFEST, bundle_folder, load_bundle, write_bundle
from trilane.avatars.manifest import UNTRAINED, Manifest, network_entry
from trilane.bench.lib.networks import untrained
from trilane.cache import cache_dir
from trilane.errors import TrilaneError

NAME = "resnet18"
ENCODER, NORM, WIDTH = "resnet18", "batch", 64
SIDE = 64  # the network is convolutional; a run reshapes it


def full_width_bundle() -> Path:
    """The bundle's folder, made when it is not there yet.

    Raises MissingPartError without PyTorch, TrilaneError when no cache folder can be written.
    """
    home = cache_dir("bench")
    if home is None:
        raise TrilaneError("the cache folder cannot be written: set XDG_CACHE_HOME to one that can")
    default = load_bundle(bundle_folder("default"))
    texture = default.read_texture().astype(np.float16)
    offsets = default.read_body().offsets
    worn = b"" if offsets is None else offsets.tobytes()
    content = hashlib.sha256(texture.tobytes() + default.body_path.read_bytes() + worn).hexdigest()[:12]
    folder = home / f"{ENCODER}-{NORM}-{WIDTH}-{content}"
    if not (folder / MANIFEST).exists():
        network = untrained(ENCODER, NORM, WIDTH, (SIDE, SIDE), texture.shape[2]).integer
        entry = network_entry(network, ENCODER, NORM, WIDTH)
        manifest = Manifest(name=NAME, network=entry, provenance={"weights": UNTRAINED})
        write_bundle(folder, manifest, default.body_path, texture, network, offsets=offsets)
    return folder
