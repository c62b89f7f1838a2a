"""The losses of a training as a log that TensorBoard shows.

Rule: writing it changes nothing of the training; a training that goes on takes back what was logged after its state.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from trilane import machine
from trilane.errors import MissingPartError

#: Seconds after which what was logged is on the disk.
FLUSH_S = 10


def require_tensorboard() -> None:
    """Raises MissingPartError where the package is not installed."""
    if not machine.here.has_package("tensorboard"):
        raise MissingPartError("a log for TensorBoard needs the package tensorboard", extra="tensorboard")


class EventLog:
    """A log in `folder`; its file is made by the first step."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._writer: Any = None

    def write(self, step: int, terms: Mapping[str, float], loss: float) -> None:
        """The `terms` of the loss at `step`, before weighting, as `terms/NAME`, and their weighted sum, as `loss`."""
        if self._writer is None:
            self._writer = _writer(self._folder, step)
        self._writer.add_scalar("loss", loss, step)
        for name, value in terms.items():
            self._writer.add_scalar(f"terms/{name}", value, step)

    def close(self) -> None:
        """Write what is left."""
        if self._writer is not None:
            self._writer.close()


def _writer(folder: Path, step: int) -> Any:
    """A writer, for which everything in `folder` from `step` on does not count."""
    from torch.utils.tensorboard import SummaryWriter

    return SummaryWriter(str(folder), purge_step=step, flush_secs=FLUSH_S)
