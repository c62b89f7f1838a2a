"""A prediction as somebody asked for it, from words to an answer: the same for a command line and for a program.

Rule: nothing is printed here, and nothing computed. What was asked for is checked and `trilane.hw_profiles` answers,
for this machine with what `this_machine.py` measured.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

from trilane.errors import BadInputError
from trilane.units import BURST, INFER, SUSTAINED, UnitName

if TYPE_CHECKING:
    from trilane.hw_profiles.application import Plan, Variant
    from trilane.hw_profiles.network_work import Network
    from trilane.hw_profiles.rates import Wanted
    from trilane.hw_profiles.schema import EngineRuntime, Profile

HOST = "host"
#: How people call precisions -> as a hardware profile does.
PRECISIONS = {"w8a8": "int8", "int8": "int8", "float": "fp16", "fp16": "fp16", "fp32": "fp32"}


def usual_cap(profile: str, *, bare: bool) -> str:
    """Return the performance profile where none is asked for.

    A network by itself (`bare`) has that of published latencies; on this machine a run has no cap.
    """
    return BURST if bare or profile == HOST else SUSTAINED


def usual_policy(profile: str) -> str:
    """Return the policy where none is asked for: a run's on this machine, else the published application's."""
    return "pipelined" if profile == HOST else "reference"


def wanted_of(fps: float | None, power_limit_w: float | None) -> Wanted:
    from trilane.hw_profiles.application import LEAST_FPS, MOST_FPS
    from trilane.hw_profiles.rates import Wanted

    if fps is not None and not LEAST_FPS <= fps <= MOST_FPS:
        raise BadInputError("--fps", f"{fps:g}", f"{LEAST_FPS:g} to {MOST_FPS:g}")
    if power_limit_w is not None and not 0 < power_limit_w < float("inf"):
        raise BadInputError("--power-limit-w", f"{power_limit_w:g}", "watts above 0")
    return Wanted(fps, power_limit_w)


def precision_of(text: str | None) -> str | None:
    if text is not None and text not in PRECISIONS:
        raise BadInputError("--precision", repr(text), "w8a8 (int8), float (fp16) or fp32")
    return None if text is None else PRECISIONS[text]


def engine_runtime_of(text: str | None) -> EngineRuntime | None:
    from trilane.hw_profiles.schema import ENGINE_RUNTIMES

    found = next((runtime for runtime in ENGINE_RUNTIMES if runtime == text), None)
    if text is not None and found is None:
        raise BadInputError("--engine-runtime", repr(text), " or ".join(ENGINE_RUNTIMES))
    return found


def check_governor(governor: str | None) -> None:
    from trilane.hw_profiles.governor import GOVERNORS

    if governor is not None and governor not in GOVERNORS:
        raise BadInputError("--governor", repr(governor), " or ".join(GOVERNORS))


def variant_of(policy: str, edge: str | None, batch: int, fps: float | None) -> Variant:
    from trilane.hw_profiles.application import REFERENCE, Variant

    if policy != "reference":
        return Variant(policy, edge or "double", batch, **({} if fps is None else {"fps": fps}))
    if edge not in (None, REFERENCE.edge):
        remedy = "choose a --policy of your own, such as pipelined"
        raise BadInputError("--edge", repr(edge), f"{REFERENCE.edge}, which the reference application has", remedy)
    return REFERENCE._replace(batch=batch)


def unit_of(runtime: str, *more: str) -> Any:
    units = (*more, "gpu", "dsp")
    if runtime not in units:
        raise BadInputError("--runtime", repr(runtime), " or ".join(", ".join(units).rsplit(", ", 1)))
    return runtime


def reference_of(encoder: str, norm: str, size: str, channels: int, layout: str) -> Network:
    from trilane.hw_profiles.reference_networks import reference_network, spec_of

    cells = {"encoder": encoder, "norm": norm, "size": size, "channels": str(channels), "layout": layout}
    return reference_network(spec_of(cells, "options"))


def predict_networks(
    chip: Profile,
    paths: list[Path],
    shapes: dict[str, tuple[int, ...]],
    on: tuple[UnitName, str | None, EngineRuntime | None],
    over: tuple[str, float, str | None, Wanted],
    say: Callable[[str], None] = lambda _: None,
) -> list[dict[str, Any]]:
    """Predict each network by itself; this machine first measures them.

    `on`: unit, its precision and the runtime of its tensor engine. `over`: performance profile, minutes, governor, and
    what is wanted. `say`: function that is told before something takes seconds.
    """
    from trilane.hw_profiles.graph_file import read_graph
    from trilane.hw_profiles.network_time import in_precision, predict_network, under_runtime
    from trilane.hw_profiles.network_work import constant_tensors

    graphs = [read_graph(path, shapes) for path in paths]
    inputs = {value.name for graph in graphs for value in graph.model.graph.input}
    if missing := [name for name in shapes if name not in inputs]:
        given = inputs.difference(*(constant_tensors(graph.model.graph) for graph in graphs))
        raise BadInputError("--input-shape", f"no input {missing[0]!r}", f"one of {', '.join(sorted(given))}")
    unit, precision, engine_runtime = on
    chips = [in_precision(chip, unit, graph.numbers, precision) for graph in graphs]
    chips = [under_runtime(each, unit, engine_runtime) for each in chips]
    if _is_measured(chip, unit, precision):
        from trilane.apps.predict.this_machine import with_file

        chips = [with_file(each, graph, shapes, say) for each, graph in zip(chips, graphs, strict=True)]
    return [predict_network(each, graph, unit, *over) for each, graph in zip(chips, graphs, strict=True)]


def network_of(
    chip: Profile,
    networks: list[Path],
    shapes: dict[str, tuple[int, ...]],
    avatar: str | None,
    layout: str,
    unit: UnitName,
    precision: str | None,
    say: Callable[[str], None] = lambda _: None,
) -> tuple[Profile, Network | None]:
    """Return the chip in the precision of a network, and the network, of a file or an avatar; None when none was named.

    This machine is measured with the network. `say`: function that is told before something takes seconds.
    """
    from trilane.avatars.bundle import load_bundle
    from trilane.hw_profiles.graph_file import image_network, read_graph
    from trilane.hw_profiles.network_time import in_precision
    from trilane.hw_profiles.network_work import Network, count_work

    if layout not in ("packed", "split"):
        raise BadInputError("--layout", repr(layout), "packed or split")
    if networks:
        graph = read_graph(networks[0], shapes)
        named, network = in_precision(chip, unit, graph.numbers, precision), image_network(graph, layout)
        if _is_measured(chip, unit, precision):
            from trilane.apps.predict.this_machine import with_file_in_application

            named = with_file_in_application(named, graph, shapes, say)
        return named, network
    chip = in_precision(chip, unit, "not said", precision)
    if avatar is None:
        return chip, None
    if _is_measured(chip, unit, precision):
        from trilane.apps.predict.this_machine import with_avatar

        return with_avatar(chip, avatar, say)
    file = load_bundle(avatar or "default").read_network()
    _, height, width, channels = file.shape
    return chip, Network({"avatar": str(avatar)}, height, width, channels, layout, count_work(file.model))


def _is_measured(chip: Profile, unit: UnitName, precision: str | None) -> bool:
    """Say whether the chip is this machine and would run the network as it was asked for."""
    return chip.name == HOST and unit == INFER[1] and precision is None


def answer_of(
    chip: Profile,
    plan: Plan,
    performance_profile: str,
    minutes: float,
    governor: str | None,
    what_if: bool,
    wanted: Wanted,
) -> dict[str, Any]:
    """Return the prediction, with the alternatives to it when `what_if` asks for them."""
    from trilane.hw_profiles import predict as predictions

    answer = predictions.predict(chip, plan, performance_profile, minutes, governor, wanted)
    if what_if:
        answer["alternatives"] = predictions.what_if(chip, plan.network, plan.runtime, performance_profile, wanted.fps)
    return answer
