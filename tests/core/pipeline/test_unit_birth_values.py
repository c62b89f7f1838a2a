"""How a unit's process is forked, named, told of its parent's death, and ends."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import threading
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import zmq

from support.small_pipeline import spec_of
from trilane import machine
from trilane.pipeline import unit_loop
from trilane.pipeline.description import UnitSettings
from trilane.transport.messages import Close, Closed, HeartbeatSocket, JobPipe, Ready, job_pipe_pair

UNIT_LIFE = """
import ctypes, fcntl, json, os, signal, sys
from types import SimpleNamespace
from trilane import machine
from trilane.pipeline import fork_server

def serve(spec, number_of):
    death = ctypes.c_int()
    ctypes.CDLL(None).prctl(2, ctypes.byref(death), 0, 0, 0)
    print(json.dumps({
        "death": death.value, "lifeline": fcntl.fcntl(lifeline, 11),  # F_GETSIG
        "name": open("/proc/self/comm").read().strip(), "own_group": os.getpgid(0) == os.getpid(),
        "cores": list(machine.here.cores()), "threads": [os.environ[name] for name in fork_server.THREAD_LIMITS],
        "spec": spec, "fds": sorted(number_of), "sigchld": signal.getsignal(signal.SIGCHLD) == signal.SIG_DFL,
        "blocked": sorted(signal.pthread_sigmask(signal.SIG_BLOCK, [])),
        "heard": [signal.getsignal(number) == signal.SIG_DFL for number in (1, 3, 15)],
        "shut": not os.path.exists(f"/proc/self/fd/{spec_fd}"),
    }), flush=True)
    print("last words", file=sys.stderr)
    if spec == "broken":
        raise ValueError("broken spec")
    return 7

loops = {"trilane.pipeline.unit_loop": SimpleNamespace(serve=serve)}
fork_server.importlib = SimpleNamespace(import_module=loops.__getitem__)
for spec in ("whole", "broken"):
    spec_fd = os.memfd_create("spec")
    os.write(spec_fd, json.dumps(spec).encode())
    said, theirs = os.pipe()
    signal.signal(signal.SIGCHLD, lambda *_: None)
    signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGCHLD})
    request = {"unit": "left-handed-unit", "cores": [min(machine.here.cores())], "threads": 3, "fds": [41]}
    lifeline, held = os.pipe()
    for number in (signal.SIGTERM, signal.SIGHUP, signal.SIGQUIT):
        signal.signal(number, signal.SIG_IGN)
    if (pid := os.fork()) == 0:
        os.close(held)
        os._exit(fork_server._run_unit(request, [spec_fd, theirs, lifeline, os.dup(1)]))
    os.close(theirs)
    code = os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1])
    print(json.dumps([code, os.read(said, 9999).decode().splitlines()]), flush=True)
"""


def test_a_unit_is_forked_into_a_life_of_its_own() -> None:
    """It outlives the server, has its name, group, cores and thread limits, and its error goes to its own stderr."""
    done = subprocess.run([sys.executable, "-c", UNIT_LIFE], capture_output=True, text=True, timeout=60, check=True)
    life, (code, said), other, (broken_code, broken_said) = map(json.loads, done.stdout.splitlines())
    assert life == {
        "death": 0,
        "lifeline": 9,
        "heard": [True] * 3,
        "name": "trilane-left-ha",
        "own_group": True,
        "cores": [min(machine.here.cores())],
        "threads": ["3"] * 4,
        "spec": "whole",
        "fds": [41],
        "sigchld": True,
        "blocked": [],
        "shut": True,
    }
    assert (code, said, done.stderr) == (7, ["last words"], "")
    assert (other["spec"], broken_code) == ("broken", 1)
    assert (broken_said[0], broken_said[-1]) == ("last words", "ValueError: broken spec")


LIFELINE = """
import os, sys
from trilane.pipeline import fork_server

lifeline, held = os.pipe()
if sys.argv[1] == "closed":
    os.close(held)
if (pid := os.fork()) == 0:
    if sys.argv[1] != "closed":
        os.close(held)
    fork_server._die_with(lifeline)
    os.write(1, b"armed ")
    while True:
        pass
if sys.argv[1] == "later":
    input()
    os.close(held)
print(os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1]))
"""


def test_the_kernel_kills_a_busy_unit_when_its_lifeline_is_closed() -> None:
    """And one that comes too late ends by itself; when the holder dies, its unit dies too: its output ends."""
    closed = subprocess.run([sys.executable, "-c", LIFELINE, "closed"], capture_output=True, timeout=60, check=True)
    assert closed.stdout.split() == [b"1"]
    pipes: Any = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE}
    for how, left in (("later", [b"-9"]), ("killed", [])):
        with subprocess.Popen([sys.executable, "-c", LIFELINE, how], **pipes) as parent:
            assert parent.stdout.read(6) == b"armed "  # type: ignore[union-attr]
            if how == "killed":
                parent.kill()
            assert parent.communicate(b"\n" if how == "later" else None, 60)[0].split() == left


def test_a_whole_unit_connects_is_ready_and_ends_when_it_is_told(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """In this process; the scheduler's cores carry its heartbeats, and its time slice is a unit's."""
    ours, theirs = job_pipe_pair()
    slices: list[int] = []
    monkeypatch.setattr(unit_loop, "use_slice", slices.append)
    monkeypatch.setattr(unit_loop, "context_on_cores", lambda cores: slices.append(cores) or zmq.Context())
    monkeypatch.setattr(unit_loop, "gc", SimpleNamespace(collect=lambda: 0, freeze=lambda: None))
    monkeypatch.setattr(unit_loop, "build_stages", lambda _: [])
    here = set(machine.here.cores())
    context = zmq.Context()
    beats, pipe = HeartbeatSocket(context), JobPipe(ours)
    beats.socket.bind(f"ipc://{tmp_path}/h")
    spec = spec_of(
        endpoint=f"ipc://{tmp_path}/h", settings=UnitSettings(cores=tuple(here), threads=1), run_cores=tuple(here),
        job_pipe=theirs,
    )  # fmt: skip
    threading.Timer(0.05, pipe.send, [Close()]).start()
    raw = json.loads(spec.model_dump_json())
    assert unit_loop.serve(raw, {fd: fd for fd in spec.fds}) == 0
    assert beats.socket.poll(2000) and beats.heartbeats() == [Ready(os.getpid())]
    assert pipe.receive() == Closed()
    assert pipe.receive() is None and pipe.ended
    assert slices == [(1, 0), 1_000_000]
    beats.close()
    pipe.close()
    context.term()


SERVER_LIFE = """
import ctypes, json, os, select, signal, socket, sys, time
from types import SimpleNamespace
from trilane import machine
from trilane.pipeline import fork_server

def death_signal():
    death = ctypes.c_int()
    ctypes.CDLL(None).prctl(2, ctypes.byref(death), 0, 0, 0)
    return death.value

def look():
    blocked = sorted(signal.pthread_sigmask(signal.SIG_BLOCK, []))
    return [death_signal(), signal.getsignal(signal.SIGCHLD) == signal.SIG_DFL, blocked, os.getppid()]

def serve(spec, number_of):
    time.sleep(spec)
    return 5

modules = {"trilane.pipeline.unit_loop": SimpleNamespace(serve=serve), "here": SimpleNamespace(look=look)}
fork_server.importlib = SimpleNamespace(import_module=modules.__getitem__)
ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
server = os.fork()
if server == 0:
    ours.close()
    fork_server.serve(theirs)
    os._exit(9)
theirs.close()

def call(name):
    reads, writes = os.pipe()
    socket.send_fds(ours, [json.dumps({"call": name}).encode()], [writes])
    os.close(writes)
    with os.fdopen(reads) as answer:
        return answer.read()

def unit(seconds):
    spec = os.memfd_create("spec")
    os.write(spec, json.dumps(seconds).encode())
    request = {"unit": "u", "cores": [min(machine.here.cores())], "threads": 1, "fds": []}
    lifeline, _held = os.pipe()
    socket.send_fds(ours, [json.dumps(request).encode()], [spec, os.dup(2), lifeline])
    answer, fds, *_ = socket.recv_fds(ours, 99, 9)
    return int(answer), fds

def until(found):
    end = time.monotonic() + 60
    while not found() and time.monotonic() < end:
        time.sleep(0.005)
    return found()

def children():
    return open(f"/proc/{server}/task/{server}/children").read().split()

death, default, blocked, parent = json.loads(call("here:look"))
until(lambda: not children())
files = os.listdir(f"/proc/{server}/fd")
pid, (pidfd, said) = unit(0.5)
named = until(lambda: open(f"/proc/{pid}/comm").read() == "trilane-u\\n")
alive = not select.select([pidfd], [], [], 0)[0]
ended = bool(select.select([pidfd], [], [], 60)[0])
none = call("no:such")
print(json.dumps([death, default, blocked, parent == server, named, alive, ended, none,
                  until(lambda: not children()), until(lambda: os.listdir(f"/proc/{server}/fd") == files),
                  os.read(said, 9).decode()]))
killed, (_, said) = unit(60)
os.kill(killed, signal.SIGKILL)
how = os.read(said, 9).decode()
_, (last, _) = unit(0.3)
ours.close()
code = os.waitstatus_to_exitcode(os.waitpid(server, 0)[1])
print(json.dumps([code, bool(select.select([last], [], [], 0)[0]), how]))
"""


def test_a_fork_server_forks_answers_forgets_and_outlives_its_units() -> None:
    """A call dies with the server too; units that ended leave no zombie, and no file; the server waits for the last.

    A unit's exit code comes through the pipe that came with its process.
    """
    done = subprocess.run([sys.executable, "-c", SERVER_LIFE], capture_output=True, text=True, timeout=60, check=True)
    first, last = map(json.loads, done.stdout.splitlines())
    assert first == [signal.SIGKILL, True, [], True, True, True, True, "", True, True, "5"]
    assert last == [9, True, "-9"]
