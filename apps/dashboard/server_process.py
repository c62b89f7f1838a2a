"""The process that shows a run, beside the pipeline's. Rule: it yields to whoever has work, and ends with the run's.

It is started with three descriptors: the listening socket, its end of the channel and the window.
"""

from __future__ import annotations

import asyncio
import os
import socket
import sys
from typing import Any, Final

from trilane.apps.dashboard.app import DashboardApp
from trilane.apps.dashboard.channel import Channel, Opened
from trilane.apps.dashboard.live_view import LiveView
from trilane.apps.dashboard.serve import server
from trilane.transport.live_window import LiveWindow
from trilane.unexpected_value import UnexpectedValue

NICE: Final = 10


async def serve(listener: socket.socket, channel: Channel, window_fd: int) -> None:
    """Show runs until the other end of `channel` is gone."""
    opened = await _first(channel)
    window = LiveWindow(window_fd, opened.height, opened.width)
    os.close(window_fd)
    view = LiveView(window, channel.send)
    app = DashboardApp(view, listener.getsockname()[1], opened.token)
    answers = server(app)
    run_is_over = asyncio.Event()
    asyncio.get_running_loop().add_reader(channel.fd, _hear, channel, view, run_is_over)
    leaving = asyncio.create_task(_leave(run_is_over, app, answers))
    os.setpriority(os.PRIO_PROCESS, 0, NICE)  # what was imported until now had to be there at once
    os.sched_setscheduler(0, os.SCHED_BATCH, os.sched_param(0))  # it takes no core from a unit by waking up
    await answers.serve(sockets=[listener])
    leaving.cancel()


async def _first(channel: Channel) -> Opened:
    while (message := channel.receive()) is None:
        await asyncio.sleep(0.01)
    if not isinstance(message, Opened):
        raise UnexpectedValue(type(message).__name__, Opened.__name__)
    return message


async def _leave(run_is_over: asyncio.Event, app: DashboardApp, answers: Any) -> None:
    await run_is_over.wait()
    await app.finish()
    answers.should_exit = True


def _hear(channel: Channel, view: LiveView, run_is_over: asyncio.Event) -> None:
    try:
        message = channel.receive()
    except EOFError:
        asyncio.get_running_loop().remove_reader(channel.fd)
        run_is_over.set()
        return
    if message is not None:
        view.hear(message)


def main() -> None:
    """Of `python -m trilane.apps.dashboard.server_process LISTENER CHANNEL WINDOW`."""
    listener_fd, channel_fd, window_fd = map(int, sys.argv[1:])
    channel = Channel(socket.socket(fileno=channel_fd))
    with socket.socket(fileno=listener_fd) as listener:
        try:
            asyncio.run(serve(listener, channel, window_fd))
        except EOFError:  # the run ended before it began
            return


if __name__ == "__main__":
    main()
