"""Processes that a bench asks for answers, each over a pipe of its own.

Rule: an answer that is text is what went wrong; the processes end with the block that started them.
"""

from __future__ import annotations

import multiprocessing
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from multiprocessing.connection import Connection
from typing import Any

from trilane.errors import TrilaneError


def answer_of(pipe: Connection, name: str, wait_s: float) -> Any:
    """The next answer of the process `name`. Raises TrilaneError when none comes, or it says what went wrong."""
    if not pipe.poll(wait_s):
        raise TrilaneError(f"{name}: no answer in {wait_s:g} s")
    try:
        answer = pipe.recv()
    except EOFError as error:
        raise TrilaneError(f"{name}: its process ended") from error
    if isinstance(answer, str):
        raise TrilaneError(f"{name}: {answer}")
    return answer


@contextmanager
def asked_processes() -> Iterator[Callable[[Callable[..., None], Any], Connection]]:
    """Starts a process each time it is called with what the process runs, and with what it is given beside its pipe."""
    context = multiprocessing.get_context("spawn")
    processes, pipes = [], list[Connection]()

    def start(serve: Callable[..., None], given: Any) -> Connection:
        ours, theirs = context.Pipe()
        process = context.Process(target=serve, args=(theirs, given), daemon=True)
        process.start()
        theirs.close()
        processes.append(process)
        pipes.append(ours)
        return ours

    try:
        yield start
    finally:
        for pipe in pipes:
            pipe.close()
        for process in processes:
            process.join(5)
            process.kill()
