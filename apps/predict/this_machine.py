"""Adds measurements of this machine to the profile `host`: calls of a network, and stages of an avatar's run.

Rule: a measurement is announced and takes at most half a minute. The result is stored for this machine and its
packages, so each measurement happens once. If a measurement fails, a message says why. The profile then stays as it is,
and its predictions have no interval.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from statistics import median

from trilane.apps.predict.asked_pipelines import NETWORK_ENDING, asked
from trilane.errors import TrilaneError
from trilane.hw_profiles.graph_file import GraphFile, read_graph
from trilane.hw_profiles.host import usable_cores
from trilane.hw_profiles.host_model import NETWORK, error_of, with_network, with_stages
from trilane.hw_profiles.network_time import price
from trilane.hw_profiles.network_work import Network
from trilane.hw_profiles.schema import Profile, corners_of
from trilane.pipeline.unit_starter import UnitStarter
from trilane.stages import PRELOAD
from trilane.stages.avatar_assets import networks_of, painting
from trilane.stages.avatar_pipeline import one_shape
from trilane.stages.blocks.network import calls_of
from trilane.stages.configure import configure, requested_runtime
from trilane.stages.machine_facts import gl_facts
from trilane.stages.placing import rehearsed
from trilane.stages.run_options import RunOptions
from trilane.units import BURST, NS_PER_MS

MEASURING = "measuring {} on this machine: at most half a minute, once for this machine and these packages ..."
#: Longest expected call that is measured. With longer calls, warm-up and counted calls would exceed half a minute.
LONGEST_CALL_MS = 4000.0
DEFAULT = "default"
Say = Callable[[str], None]


def with_avatar(chip: Profile, avatar: str, say: Say) -> tuple[Profile, Network]:
    """Return (`chip` with measured times of a run of `avatar`, the avatar's network at the usual tensor shape).

    `chip`: profile `host`. `avatar`: name or folder.
    `say`: function that gets a message before a measurement, and after a measurement that failed.

    If the measurement fails, `chip` is returned unchanged. Raises BadInputError if `avatar` is no avatar, and
    MissingPartError if a part that a run needs is not installed.
    """
    measured, network = _with_run(chip, RunOptions(avatar=avatar), say)
    return measured, network._replace(facts={"avatar": avatar})


def _with_run(chip: Profile, request: RunOptions, say: Say) -> tuple[Profile, Network]:
    """Return (`chip` with measured times of the run that `request` describes, its network at the usual tensor shape).

    The times come from the rehearsal that also chooses the run's placement. The avatars of the run share one tensor,
    and each avatar gets an equal share of the time for poses. `chip`, `say`, and a failed measurement: as in
    `with_avatar`.

    Raises BadInputError for options that no run can have, MissingPartError as `with_avatar` does.
    """
    checked = configure(request, Path.cwd())
    network = painting(networks_of(checked.assets), one_shape(checked.config), {"scene": request.scene})
    try:
        with UnitStarter(PRELOAD) as starter:
            found, at = rehearsed(checked, starter, str(gl_facts()), lambda _: say(MEASURING.format("the stages")))
    except TrilaneError as error:
        return _unmeasured(chip, error, say), network
    said = f"measured on this machine at {at}: frames of a run, one at a time, with {checked.config.runtime}"
    ms = {threads: work.serial_ns / NS_PER_MS for threads, work in found.times[NETWORK].items()}
    frames = [sum(frame) for frame in zip(*found.took_ns.values(), strict=True)]
    measured = with_network(chip, network.work, ms, error_of(frames), said)
    return with_stages(measured, network, found.took_ns, said, len(checked.config.avatar_dirs)), network


def with_first(chip: Profile, text: str, say: Say) -> Profile:
    """Return `chip` with measurements of the first pipeline that shares it: a scene or a network.

    If the measurement fails, or for a pipeline file, `chip` is returned unchanged. `text`: pipeline as typed on the
    command line. `chip`, `say`: as in `with_avatar`.

    Raises BadInputError for a text that describes no pipeline, and for a scene or network that cannot be used. Raises
    MissingPartError as `with_avatar` does.
    """
    first = asked(text)
    if first.what.endswith(NETWORK_ENDING):
        return with_file(chip, read_graph(Path(first.what)), {}, say)
    if first.is_file:
        return _unmeasured(chip, "the networks of a pipeline file are measured where it stands alone", say)
    return _with_run(chip, RunOptions(scene=first.what), say)[0]


def with_file_in_application(chip: Profile, graph: GraphFile, shapes: Mapping[str, Sequence[int]], say: Say) -> Profile:
    """Return `chip` with the measured times of an application: the default avatar's stages with the network in `graph`.

    A run of the default avatar and calls of the network are measured one after the other. If a measurement fails,
    `chip` is returned unchanged. `chip`, `graph`, `shapes`, `say`: as in `with_file`.
    """
    usual, _ = with_avatar(chip, DEFAULT, say)
    placed = usual.units[NETWORK].measured
    if placed is None:
        return chip
    measured = with_file(chip, graph, shapes, say, tuple(placed.slower))
    if measured.units[NETWORK].measured is None:
        return chip
    return measured.model_copy(update={"application": usual.application})


def with_file(
    chip: Profile,
    graph: GraphFile,
    shapes: Mapping[str, Sequence[int]],
    say: Say,
    counts: Sequence[int] = (),
    runtime: str = "",
) -> Profile:
    """Return `chip` with the measured time of the network in `graph`; unchanged if the network cannot be measured.

    `chip`, `say`: as in `with_avatar`. `shapes`: shapes of inputs by name, in place of the file's own.
    `counts`: numbers of threads to measure with; if empty, the number of threads of the unit for networks.
    `runtime`: runtime of the pipeline stage that has this network; "" if the network is no stage. In this case, an
    avatar's integer network uses the fastest installed runtime, and any other network uses ONNX Runtime.
    """
    why = _why_not(chip, graph)
    if why:
        return _unmeasured(chip, why, say)
    cores = usable_cores()
    try:
        runs = runtime or requested_runtime("auto")[0]
        threads, told = counts or (chip.units[NETWORK].threads,), lambda: say(MEASURING.format(graph.path.name))
        found = calls_of(graph.path, shapes, runs, threads, cores, told, as_stage=bool(runtime))
    except TrilaneError as error:
        return _unmeasured(chip, error, say)
    said = f"measured on this machine at {found.at}: calls of the network by itself, with {found.runtime}"
    ms = {count: median(took) / NS_PER_MS for count, took in found.took_ns.items()}
    scatter = max(error_of(took) for took in found.took_ns.values())
    return with_network(chip, graph.work, ms, scatter, said)


def _why_not(chip: Profile, graph: GraphFile) -> str:
    """Return the reason why the network in `graph` is not measured; "" if it can be measured."""
    if graph.numbers == "not said":
        return "the file has no weights"
    ms = price(chip, graph.work, NETWORK, corners_of(chip, BURST)).total_ms
    return f"a call is expected to take {ms / 1e3:.0f} s, which is too long" if ms > LONGEST_CALL_MS else ""


def _unmeasured(chip: Profile, why: TrilaneError | str, say: Say) -> Profile:
    say(f"not measured on this machine: {why}")
    return chip
