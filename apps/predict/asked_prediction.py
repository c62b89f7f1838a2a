"""Predictions from options to an answer, for the command line and for programs alike.

Rule: this module neither prints nor computes. `trilane.hw_profiles` computes the answers. If the chip is this machine,
the answers rest on measurements by `this_machine.py`. In all functions, `chip` is the chip's hardware profile,
`options` are the options of the prediction, and the function `say` gets a message before an action that takes seconds.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Final

from trilane.apps.predict.predict_options import PredictOptions
from trilane.errors import BadInputError
from trilane.units import HOST, INFER, UnitName

if TYPE_CHECKING:
    from trilane.hw_profiles.application import Plan
    from trilane.hw_profiles.network_work import Network
    from trilane.hw_profiles.prediction import ApplicationPrediction, NetworkPrediction
    from trilane.hw_profiles.schema import Profile

#: Note on a prediction without options that choose network, policy or edge.
AS_RUN: Final = "the avatar, policy and edge are those of `trilane run` without options"


def predict_networks(
    chip: Profile, options: PredictOptions, say: Callable[[str], None] = lambda _: None
) -> list[NetworkPrediction]:
    """Return a prediction for each network of `options` by itself, on each unit of `options`.

    With the profile `host` and no requested precision, calls of each network on this machine's unit for networks are
    measured first.

    Raises BadInputError for a network that cannot be read, and for an unknown unit or input.
    """
    from trilane.hw_profiles.graph_file import read_graph
    from trilane.hw_profiles.network_time import Computes, predict_network
    from trilane.hw_profiles.network_work import constant_tensors

    shapes, over = options.shapes, (options.cap, options.minutes, options.governor, options.wanted)
    units = options.units
    graphs = [read_graph(path, shapes) for path in options.network]
    inputs = {value.name for graph in graphs for value in graph.model.graph.input}
    if missing := [name for name in shapes if name not in inputs]:
        given = inputs.difference(*(constant_tensors(graph.model.graph) for graph in graphs))
        raise BadInputError("--input-shape", f"no input {missing[0]!r}", f"one of {', '.join(sorted(given))}")
    answers = []
    for graph in graphs:
        for unit in units:
            used = Computes(graph.numbers, options.numbers, options.engine).on(chip, unit)
            if _is_measured(chip, options, unit):
                from trilane.apps.predict.this_machine import with_file

                used = with_file(used, graph, shapes, say)
            answers.append(predict_network(used, graph, unit, *over))
    return answers


def application_of(
    chip: Profile, options: PredictOptions, say: Callable[[str], None] = lambda _: None
) -> tuple[Profile, Plan]:
    """Return (chip in the network's precision, avatar application with the network that `options` select).

    With the profile `host`, the network is first measured on this machine. Nothing is measured for a published network,
    for a requested precision, or for another unit than the machine's unit for networks.

    Raises BadInputError for a network or avatar that cannot be read, and for options that no application has.
    """
    from trilane.hw_profiles.application import Plan

    chip, network = _network_of(chip, options, say)
    return chip, Plan(network, options.network_unit, options.variant, options.gpu_share)


def _network_of(chip: Profile, options: PredictOptions, say: Callable[[str], None]) -> tuple[Profile, Network]:
    from trilane.avatars.bundle import DEFAULT, load_bundle
    from trilane.hw_profiles.graph_file import image_network, read_graph
    from trilane.hw_profiles.network_time import Computes
    from trilane.hw_profiles.network_work import Network, count_work
    from trilane.hw_profiles.reference_networks import reference_network, spec_of

    unit, avatar = options.network_unit, options.avatar or DEFAULT
    if options.network:
        graph = read_graph(options.network[0], options.shapes)
        named, network = Computes(graph.numbers, options.numbers).on(chip, unit), image_network(graph, options.layout)
        if _is_measured(chip, options, unit):
            from trilane.apps.predict.this_machine import with_file_in_application

            named = with_file_in_application(named, graph, options.shapes, say)
        return named, network
    chip = Computes(precision=options.numbers).on(chip, unit)
    if options.is_published:
        cells = options.as_json()
        names = ("encoder", "norm", "size", "channels", "layout")
        return chip, reference_network(spec_of({name: str(cells[name]) for name in names}, "options"))
    if _is_measured(chip, options, unit):
        from trilane.apps.predict.this_machine import with_avatar

        return with_avatar(chip, avatar, say)
    file = load_bundle(avatar).read_network()
    _, height, width, channels = file.shape
    return chip, Network({"avatar": avatar}, height, width, channels, options.layout, count_work(file.model))


def _is_measured(chip: Profile, options: PredictOptions, unit: UnitName) -> bool:
    """Return whether the network is to be measured on this machine.

    It is measured if the chip is this machine, `unit` is the unit for networks, and `options` request no precision. A
    run on this machine uses a network in no other way.
    """
    return chip.name == HOST and unit == INFER[1] and options.precision is None


def answer_of(chip: Profile, plan: Plan, options: PredictOptions) -> ApplicationPrediction:
    """Return the prediction of the application `plan` on `chip`.

    With `what_if` in `options`, `alternatives` has predictions with other policies and edges.
    """
    from trilane.hw_profiles import predict as predictions

    cap, wanted = options.cap, options.wanted
    answer = predictions.predict(chip, plan, cap, options.minutes, options.governor, wanted)
    if options.what_if:
        rows = predictions.what_if(chip, plan.network, plan.unit, cap, wanted.fps)
        answer = answer.model_copy(update={"alternatives": tuple(rows)})
    return answer.model_copy(update={"notes": (AS_RUN, *answer.notes)}) if options.is_as_run else answer
