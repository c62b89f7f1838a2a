"""Where the arrays of a stage's ports lie in a slot."""

from __future__ import annotations

import numpy as np
import pytest

from trilane.pipeline.file_keys import port_type
from trilane.pipeline.stage import payload_bytes, views

PORTS = {"mask": port_type("u8 5x13"), "boxes": port_type("f32 2x3"), "seen": port_type("bool 4")}


def test_ports_lie_one_after_the_other_each_on_its_own_cache_lines() -> None:
    """65 bytes take two lines of 64, 24 bytes and 4 bytes take one each."""
    assert payload_bytes(PORTS) == 128 + 64 + 64
    payload = np.zeros(256, np.uint8)
    arrays = views(payload, PORTS)
    assert [(array.dtype.name, array.shape) for array in arrays.values()] == [
        ("uint8", (5, 13)),
        ("float32", (2, 3)),
        ("bool", (4,)),
    ]
    arrays["mask"][-1, -1], arrays["boxes"][0, 0], arrays["seen"][3] = 7, 1.0, True
    assert (payload[64], payload[128:132].view("<f4")[0], payload[195], payload.astype(bool).sum()) == (7, 1.0, 1, 4)


def test_a_slot_that_is_too_small_is_refused() -> None:
    with pytest.raises(ValueError, match="a slot of 150 bytes, 152 needed"):
        views(np.zeros(150, np.uint8), PORTS)
