"""The run's end of its server: starts the process, hands it what is to be shown, hears what is asked.

Rule: it ends with this object; the run goes on without it when it ends by itself.
"""

from __future__ import annotations

import contextlib
import os
import select
import subprocess
import sys
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Final

from trilane.apps.dashboard.channel import Asked, Message, Opened, channel_pair
from trilane.apps.dashboard.serve import Place
from trilane.transport.live_window import create_window, path_of

CLOSE_S: Final = 3.0
ENDED: Final = "the dashboard's server has ended; the run goes on without it"


class ServerLink:
    """A server at `place` for pictures of `height` x `width`.

    `hear`: given what the page asks for, on a thread of its own. `tell`: given a sentence for a person.
    """

    def __init__(
        self, place: Place, height: int, width: int, hear: Callable[[Asked], None], tell: Callable[[str], None]
    ) -> None:
        self._hear, self._tell = hear, tell
        self._window_fd = create_window(height, width)
        self.window: Path = path_of(self._window_fd)
        self._channel, theirs = channel_pair()
        self._end_fd = os.eventfd(0, os.EFD_CLOEXEC)
        with theirs:
            fds = (place.listener.fileno(), theirs.fileno(), self._window_fd)
            self._process = subprocess.Popen(
                [sys.executable, "-P", "-m", "trilane.apps.dashboard.server_process", *map(str, fds)],
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
                pass_fds=fds,
                process_group=0,  # an interrupt of the terminal is the run's to hear; the server ends after it
            )
        self.send(Opened(place.token, height, width))
        self._thread = threading.Thread(target=self._listen, name="dashboard", daemon=True)
        self._thread.start()

    def send(self, message: Message) -> None:
        """To the server, if it is there and listens."""
        self._channel.send(message)

    def close(self) -> None:
        """The server has ended when this returns."""
        os.eventfd_write(self._end_fd, 1)
        self._thread.join()
        self._channel.close()
        try:
            self._process.wait(CLOSE_S)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        os.close(self._end_fd)
        os.close(self._window_fd)

    def _listen(self) -> None:
        poller = select.poll()
        poller.register(self._channel.fd, select.POLLIN)
        poller.register(self._end_fd, select.POLLIN)
        with contextlib.suppress(EOFError):
            while self._end_fd not in [fd for fd, _ in poller.poll()]:
                message = self._channel.receive()
                if isinstance(message, Asked):
                    self._hear(message)
            return
        self._tell(ENDED)
