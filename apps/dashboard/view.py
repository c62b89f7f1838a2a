"""What a server shows: a run that goes on (`live_view.py`) or one that is over (`finished_view.py`).

Rule: a view answers at once or awaits; it never blocks the loop that all clients share.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, Protocol

from trilane.apps.dashboard.clients import Client
from trilane.apps.dashboard.wire import ControlSaid, Seek

Message = Mapping[str, Any]


class View(Protocol):
    """A run as a server shows it. Messages are those of docs/dashboard.md."""

    def greeting(self) -> Iterable[Message]:
        """What a client is told first: the hello, the state, and what happened lately."""

    async def news(self, *, is_watched: bool) -> Iterable[Message]:
        """What all clients are told: what happened since the last call; nothing when there are none to watch it."""

    async def picture(self, client: Client) -> bytes | None:
        """The newest picture, as `wire.shown` writes it, when `client` has not had it; notes that it has now."""

    def control(self, asked: ControlSaid) -> str:
        """Do what was asked, or begin to; why not, "" when it is done."""

    async def seek(self, client: Client, to: Seek) -> Iterable[Message]:
        """What `client` is told of another time of the run."""

    def metrics(self) -> str:
        """The run's figures in OpenMetrics, without the end mark; "" before there are any."""

    @property
    def trace(self) -> Path | None:
        """The run's trace, as far as it is written."""
