"""The shared memory of a run's edges. Rule: the parent makes a region for each edge, and closes it whatever happens."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator

from trilane.pipeline.description import HeaderDtype, Model, Pipeline
from trilane.transport.packets import RegionLayout, SlotLayout, create_region
from trilane.transport.slots import edge_rule


class EdgeRegion(Model):
    """A region that a unit maps.

    `fd`: descriptor, which the unit's process inherits.
    `slots`: number of slots.
    `header`: dtype of every packet's header.
    `payload_bytes`: bytes of every packet's payload.
    """

    fd: int
    slots: int
    header: HeaderDtype
    payload_bytes: int

    @property
    def layout(self) -> RegionLayout:
        return RegionLayout(self.slots, SlotLayout(self.header, self.payload_bytes))


@contextlib.contextmanager
def edge_regions(pipeline: Pipeline) -> Iterator[dict[str, EdgeRegion]]:
    """Yield a region for each edge, by the edge's name; raises TrilaneError when there is too little memory."""
    regions: dict[str, EdgeRegion] = {}
    try:
        for name, edge in zip(pipeline.edge_names, pipeline.edges, strict=True):
            slots = edge_rule(edge.rule).slots
            fd = create_region(name, RegionLayout(slots, SlotLayout(edge.header, edge.payload_bytes)))
            regions[name] = EdgeRegion(fd=fd, slots=slots, header=edge.header, payload_bytes=edge.payload_bytes)
        yield regions
    finally:
        for region in regions.values():
            os.close(region.fd)
