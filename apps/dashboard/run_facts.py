"""Facts about a run for the page that do not change during the run, and the controls of the page.

Rule: an unknown fact is null or empty, never guessed. Names are the same as in report.json. Only a `Control` states the
valid values of a control.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from trilane.options import NOTHING, option_of
from trilane.pipeline.journal import Begun, config_of
from trilane.stages.run_options import RunOptions
from trilane.units import TARGET_FPS

if TYPE_CHECKING:
    from trilane.apps.run.report import Report
    from trilane.stages.configure import Checked

ACTION, CHOICE, NUMBER, DRAG = "action", "choice", "number", "drag"
LEAST_ZOOM, MOST_ZOOM = 0.25, 4.0
MOST_DRAG_DEG: Final = 360.0
#: Controls that the server itself carries out, through the window.
OF_THE_CAMERA: Final = ("orbit", "zoom", "recentre")
#: Controls whose change needs a new run.
OF_A_NEW_RUN: Final = tuple(
    name for name, field in RunOptions.model_fields.items() if option_of(field).offered is not None
)
Value = str | float | list[float] | None


@dataclass(frozen=True)
class RunFacts:
    """Facts about a run for the page that do not change during the run.

    `name`: name of the run folder. `scene`: name of the scene. `clock`: host or virtual.
    `machine`: processor, cores and OpenGL driver in one line, for people.
    `fps`: frames a second of the scene. `output`: (width, height) of pictures in pixels.
    `config`: value of each control at the beginning of the run, by name.
    `plan`: key `plan` of report.json, with the report's `notes`.
    `placement`, `accuracy`: as in report.json; `placement` is None if it is unknown.
    `bound`: bound and efficiencies of a finished run: the keys of report.json that `BOUND` lists. None if unknown.
    `verdict`: verdict of a finished run, with its lines; None if unknown.
    """

    name: str
    scene: str
    clock: str
    machine: str
    fps: float
    output: tuple[int, int]
    config: Mapping[str, str]
    plan: Mapping[str, Any]
    placement: Mapping[str, Any] | None
    accuracy: Mapping[str, Any]
    bound: Mapping[str, Any] | None = None
    verdict: Mapping[str, Any] | None = None

    @classmethod
    def of_row(cls, row: Mapping[str, Any]) -> RunFacts:
        """Return the facts from `row`, which has the value of each field and was sent in a message."""
        width, height = row["output"]
        return cls(**{**row, "output": (width, height)})

    def hello(self) -> dict[str, Any]:
        """Return the part of the message `hello` with facts about the run."""
        return {
            "name": self.name,
            "scene": self.scene,
            "clock": self.clock,
            "machine": self.machine,
            "fps": self.fps,
            "output": list(self.output),
        }

    def state(self, state: str, why: str = "") -> dict[str, Any]:
        """Return the message `state`, which also has facts about the run.

        `state`: state of the run, such as running.
        `why`: reason of the state in words, "" without a reason.
        """
        facts = {"plan": self.plan, "placement": self.placement, "accuracy": self.accuracy, "bound": self.bound}
        facts["verdict"] = self.verdict
        return {"type": "state", "is": state, "why": why, "config": self.config, **facts}


def config_in_force(config: Mapping[str, Any], options: Mapping[str, Any]) -> dict[str, str]:
    """Return the present value of each control in OF_A_NEW_RUN, by name, spelt as in its choices.

    For a pipeline file, return only `policy` and `edge`.
    `config`: block `config` of report.json.
    `options`: given options by name, for values that `config` lacks.
    """
    if "pipeline" in config:  # a pipeline file has no controls that need a new run
        return {name: str(config[name]) for name in ("policy", "edge")}
    scene = config["scene"]
    avatar = next((avatar["bundle"] for avatar in scene.get("avatars", ())), None)
    chosen = {**config, "size": scene.get("size"), "avatar": avatar}
    values = {name: options.get(name) if chosen.get(name) is None else chosen[name] for name in OF_A_NEW_RUN}
    return {name: NOTHING if value is None else str(value) for name, value in values.items()}


def _machine_line(machine: Mapping[str, Any]) -> str:
    """Return processor, cores and OpenGL driver in one line. `machine`: block `machine` of report.json."""
    cpu, driver = machine["cpu"], machine.get("gl")
    cores = f"{len(cpu['cores_allowed'])} of {cpu['cores']} cores"
    drawn = f", {driver['renderer']}" if driver else ""
    return f"{cpu['model']}, {cores}{drawn}"


#: Keys of a report for the bound of a run, and for its efficiencies.
BOUND: Final = ("bottleneck", "bound", "efficiency", "core_efficiency", "machine_efficiency")


def facts_of_checked(name: str, checked: Checked, options: RunOptions, machine: Mapping[str, Any]) -> RunFacts:
    """Return the facts of a scene's run that begins.

    `name`: name of the run folder.
    `checked`: checked configuration of the run.
    `options`: options of the run.
    `machine`: block `machine` of report.json.
    """
    # Functions here import these modules themselves: a live run's server needs none of them, and starts sooner without.
    from trilane.apps.run.report_facts import config_facts

    config = checked.config
    said = config_facts(config, options.policy, options.edge)
    plan = {"tensor_shapes": [list(shape) for shape in config.buckets], "notes": list(checked.notes)}
    facts = facts_of_config(name, said, machine, dict(options))
    return replace(facts, plan=plan, placement=checked.placement, accuracy=checked.accuracy)


def facts_of_config(
    name: str, config: Mapping[str, Any], machine: Mapping[str, Any], options: Mapping[str, Any]
) -> RunFacts:
    """Return the facts of a run that begins, without the facts of its avatars.

    `name`: name of the run folder.
    `config`, `machine`: blocks of report.json.
    `options`: as in `config_in_force`.
    """
    scene, values = config["scene"], config_in_force(config, options)
    line, output = _machine_line(machine), _output(scene)
    return RunFacts(name, scene["name"], "host", line, scene.get("fps", TARGET_FPS), output, values, {}, None, {})


def facts_of_report(name: str, report: Report) -> RunFacts:
    """Return the facts of a finished run.

    `name`: name of the run folder.
    `report`: report of the run.
    """
    from trilane.apps.run.verdict_facts import verdict_of

    document = report.as_json()
    return replace(
        facts_of_config(name, report.config, document["machine"], {**document.get("options", {}), **document["caps"]}),
        clock=report.clock,
        plan={**(document.get("plan") or {}), "notes": list(report.notes)},
        placement=document.get("placement"),
        accuracy=report.accuracy,
        bound={key: document.get(key) for key in BOUND} if report.bound is not None else None,
        verdict=verdict_of(report, name).shown(),
    )


def _output(scene: Mapping[str, Any]) -> tuple[int, int]:
    """Return (width, height) of pictures in pixels; (640, 480) if no size is stated.

    `scene`: block `scene` of `config` in report.json.
    """
    output = scene.get("output") or {}
    return output.get("width", 640), output.get("height", 480)


def facts_of_folder(folder: Path, begun: Begun) -> RunFacts:
    """Return the facts of the run in `folder`, from its report or, without a report, from its journal.

    `begun`: first record of the journal.
    Raises BadInputError for a report that cannot be read.
    """
    from trilane.apps.run.report import REPORT_FILE, read_report

    if (folder / REPORT_FILE).is_file():
        return facts_of_report(folder.name, read_report(folder))
    facts = begun.facts
    scene = config_of(begun).get("scene", {})
    machine = facts.get("machine")
    return RunFacts(
        folder.name,
        scene.get("name", folder.name),
        str(facts.get("clock", "host")),
        _machine_line(machine) if machine else "",
        scene.get("fps", TARGET_FPS),
        _output(scene),
        {"policy": begun.settings.policy},
        {},
        None,
        facts.get("accuracy") or {},
    )


@dataclass(frozen=True)
class Control:
    """A control of the page.

    `name`: name of the control.
    `kind`: action, choice, number or drag.
    `live`: whether a use of the control changes the running run; if not, it needs a new run.
    `choices`: valid values of a choice, empty for other kinds.
    `min`, `max`: range of a number, or of both numbers of a drag; None for other kinds.
    `why_not`: reason for which the control is disabled, "" if it is enabled.
    """

    name: str
    kind: str
    live: bool
    choices: tuple[str, ...] = ()
    min: float | None = None
    max: float | None = None
    why_not: str = ""

    def refusal(self, value: Value) -> str:
        """Return why the control cannot have `value`, in words; "" if the control can have it."""
        if self.why_not:
            return self.why_not
        if self.kind == ACTION:
            return "" if value is None else "found a value, expected none"
        if self.kind == CHOICE:
            return "" if value in self.choices else f"found {value!r}, expected one of {', '.join(self.choices)}"
        numbers = value if self.kind == DRAG else [value]
        if isinstance(numbers, list) and all(self._has_room_for(number) for number in numbers):
            return ""
        found = "two numbers" if self.kind == DRAG else "a number"
        return f"found {value!r}, expected {found} from {self.min:g} to {self.max:g}"

    def _has_room_for(self, number: Any) -> bool:
        assert self.min is not None and self.max is not None
        is_number = isinstance(number, int | float) and not isinstance(number, bool)
        return is_number and self.min <= number <= self.max

    def as_json(self, value: Any) -> dict[str, Any]:
        """Return the control's row in the message `hello`, with its present `value`."""
        return {**asdict(self), "value": value}


def control_of(row: Mapping[str, Any]) -> Control:
    """Return the control from `row`, which has the value of each field and was sent in a message."""
    return Control(**{**row, "choices": tuple(row["choices"])})


def controls_of_run(
    units: Sequence[str], choices: Mapping[str, Sequence[str]], why_not: Mapping[str, str]
) -> tuple[Control, ...]:
    """Return the controls of a scene's run.

    `units`: names of the units that can be killed.
    `choices`: valid values of each control in OF_A_NEW_RUN, by the control's name.
    `why_not`: reason why a control in OF_A_NEW_RUN is disabled, by the control's name; other controls are enabled.
    """
    camera = (
        Control("orbit", DRAG, True, min=-MOST_DRAG_DEG, max=MOST_DRAG_DEG),
        Control("zoom", NUMBER, True, min=LEAST_ZOOM, max=MOST_ZOOM),
        Control("recentre", ACTION, True),
    )
    restarting = (
        Control(name, CHOICE, False, choices=tuple(choices[name]), why_not=why_not.get(name, ""))
        for name in OF_A_NEW_RUN
    )
    *held, kill = controls_of_file(units)
    return (*held, *camera, kill, *restarting)


def controls_of_file(units: Sequence[str]) -> tuple[Control, ...]:
    """Return the controls of a pipeline file's run, which has no camera to steer.

    `units`: names of the units that can be killed.
    """
    return (
        Control("play", ACTION, True),
        Control("pause", ACTION, True),
        Control("step", ACTION, True),
        Control("kill", CHOICE, True, choices=tuple(units)),
    )
