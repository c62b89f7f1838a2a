"""The Typer application of the commands, and the options that several commands share.

Rule: an option with a single value is refused if it is given twice, because one value would silently replace the other.
Errors about a value state what was found and what was expected. Options of a run are fields of `RunOptions`. Other
shared options are defined here. An option has the same spelling and explanation in all commands.
"""

from __future__ import annotations

import inspect
from collections import Counter
from collections.abc import Callable, Collection, Iterator, Sequence
from enum import Enum
from pathlib import Path
from typing import Annotated, Any, Literal, get_args, get_origin

import typer
from pydantic import ValidationError
from typer.core import TyperCommand, TyperOption

from trilane.apps.predict.predict_options import ENCODER_HELP, FIXED_SIZE_HELP, NORM_HELP
from trilane.errors import BadInputError, did_you_mean
from trilane.options import EMPTY_PATH, Options, element_of, expected, kind_of, limits_of, option_of
from trilane.stages.run_options import PROFILE_HELP, WIDTH_HELP, RunOptions
from trilane.units import AVATARS_HELP, CALIBRATION_METHODS, MAX_CHANNELS, either

#: Name of the attribute of a command's function that holds the class of the command's options.
OPTIONS = "options_model"
#: Pydantic's name of a kind of number -> plain name.
IN_PLAIN_WORDS = {"a valid number": "a number", "a valid integer": "a whole number"}
JsonOption = Annotated[bool, typer.Option("--json", help="Print one JSON document on stdout and nothing else there.")]
OutFileOption = Annotated[Path, typer.Option("--out", help="File to write.")]
NewestRunArgument = Annotated[
    Path | None,
    typer.Argument(help="Run folder, its journal, or its name below runs/; the newest below runs/ if none is given."),
]
PortOption = Annotated[
    int | None, typer.Option(min=1024, max=65535, help="Port to listen on, on this machine; any free one if not given.")
]


class OnceCommand(TyperCommand):
    """A command that refuses an option with one value if the option is given twice."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Parse `args` as Typer does. Raises BadInputError for an option that is given twice or has a wrong value.

        An empty path or argument is an error too. `--hud` and `--no-hud` are the same option.
        """
        typed, _, given = self.make_parser(ctx).parse_args(args=list(args))
        for parameter in self.params:
            _refuse_empty(parameter, typed.get(parameter.name))
        for option, times in Counter(given).items():
            if times > 1 and isinstance(option, TyperOption) and not _may_be_repeated(option):
                names = " or ".join([*option.opts, *option.secondary_opts])
                raise BadInputError("options", f"{names} given {times} times", "it once", "it takes one value")
        try:
            return super().parse_args(ctx, args)
        except typer.BadParameter as error:
            if isinstance(error.__cause__, ValidationError) and error.param is not None:
                raise _wrong_value(error.param, error.__cause__, getattr(self.callback, OPTIONS, None)) from None
            raise


def _refuse_empty(parameter: Any, typed: str | Sequence[str] | None) -> None:
    """Raise BadInputError for an empty path, which Typer would read as `.`, and for an empty text of an argument.

    `parameter`: Typer's option or argument. `typed`: value as typed; a sequence if the parameter takes several values,
    None if the parameter is not on the command line.
    """
    kinds = [*_kinds(parameter.type_descriptor.annotation)]
    names_a_thing = parameter.param_type_name == "argument" and str in kinds
    texts = [typed] if isinstance(typed, str) else typed or ()
    if (Path in kinds or names_a_thing) and any(isinstance(text, str) and not text.strip() for text in texts):
        raise BadInputError(parameter.opts[0], *EMPTY_PATH)


def _kinds(kind: Any) -> Iterator[Any]:
    """Yield the type `kind` and, recursively, the types of its arguments, such as Path in `list[Path]`."""
    yield kind
    for each in get_args(kind):
        yield from _kinds(each)


def _wrong_value(parameter: Any, error: ValidationError, model: type[Options] | None) -> BadInputError:
    """Return the error about the value of an option or argument that pydantic has refused.

    `parameter`: Typer's option or argument. `error`: pydantic's error. `model`: class of the command's options; None
    for a command without such a class.
    """
    first, kind = error.errors()[0], parameter.type_descriptor.annotation
    where = parameter.opts[0]
    found = first["input"]
    choices = [each.value for each in kind] if isinstance(kind, type) and issubclass(kind, Enum) else get_args(kind)
    if choices and get_origin(kind) in (None, Literal):
        words = [str(each) for each in choices]
        return BadInputError(where, repr(found), f"one of {', '.join(words)}", did_you_mean(str(found), words))
    if model is not None and parameter.name in model.model_fields:
        return BadInputError(where, repr(found), expected(model.model_fields[parameter.name]))
    wanted = first["msg"].removeprefix("Input should be ").partition(",")[0]
    return BadInputError(where, repr(found), IN_PLAIN_WORDS.get(wanted, wanted))


def _may_be_repeated(option: TyperOption) -> bool:
    """Return whether `option` may be repeated: whether it collects or counts values, or is a flag without opposite."""
    return option.multiple or option.count or (option.is_flag and not option.secondary_opts)


def given(ctx: typer.Context) -> set[str]:
    """Return the names of the command's parameters that the user has given on the command line."""
    sources = {name: ctx.get_parameter_source(name) for name in ctx.params}
    return {name for name, source in sources.items() if source is not None and source.name == "COMMANDLINE"}


class Commands(typer.Typer):
    """A Typer application without markup and shell completion. Each of its commands is a `OnceCommand`."""

    def __init__(self, **settings: Any) -> None:
        super().__init__(rich_markup_mode=None, add_completion=False, **settings)

    def command(self, name: str | None = None, **settings: Any) -> Callable[[Any], Any]:
        """Return a decorator that registers a function as a `OnceCommand`.

        `name`: name of the command; None for the name of the function. `settings`: as for `typer.Typer.command`.
        """
        return super().command(name, cls=OnceCommand, **settings)


def _described(model: type[Options], name: str) -> Any:
    """Return Typer's option or argument for field `name` of `model`. `model` checks each value on the command line."""
    field = model.model_fields[name]
    option = option_of(field)

    def checked(value: Any) -> Any:
        if value is not None:
            model.checked({name: value}, as_typed=True)
        return value

    least, most = limits_of(field)
    settings: dict[str, Any] = {"help": field.description, "callback": checked, "min": least, "max": most}
    if option.is_argument:
        return typer.Argument(**settings)
    is_pair = kind_of(field) is bool and not option.spelling  # Typer spells it --NAME/--no-NAME
    return typer.Option(*() if is_pair else (model.spelling(name), *option.synonyms), **settings)


def with_options(
    model: type[Options], names: Collection[str] | None = None
) -> Callable[[Callable[..., None]], Callable[..., None]]:
    """Return a decorator for a command whose first parameter is an instance of `model`. Each field becomes an option.

    Typer reads the options of a command from its signature. Therefore the decorator builds a signature with a parameter
    for each field. In the instance that the command gets, only fields from the command line count as set.

    `model`: class of the command's options. `names`: names of the fields that become options; None for all fields.
    """
    fields = [name for name in model.model_fields if names is None or name in names]

    def decorated(command: Callable[..., None]) -> Callable[..., None]:
        _, *own = inspect.signature(command, eval_str=True).parameters.values()
        context = inspect.Parameter("ctx", inspect.Parameter.KEYWORD_ONLY, annotation=typer.Context)
        takes_context = any(parameter.name == context.name for parameter in own)

        def called(ctx: typer.Context, **values: Any) -> None:
            typed = given(ctx)
            asked = {name: value for name in fields if (value := values.pop(name)) is not None and name in typed}
            if takes_context:
                values["ctx"] = ctx
            command(model.checked(asked, as_typed=True), **values)

        parameters = [_parameter(model, name) for name in fields]
        rest = [parameter.replace(kind=context.kind) for parameter in own if parameter.name != context.name]
        called.__signature__ = inspect.Signature([context, *parameters, *rest])  # type: ignore[attr-defined]
        called.__name__, called.__doc__ = command.__name__, command.__doc__
        setattr(called, OPTIONS, model)
        return called

    return decorated


def _parameter(model: type[Options], name: str) -> inspect.Parameter:
    field = model.model_fields[name]
    words, kind = option_of(field).words, kind_of(field)
    element: Any = element_of(field) if kind is tuple else None
    typed: Any = Literal[words] if words else list[element] if element else kind
    default = None if field.default == () else field.default
    annotation: Any = Annotated[typed if default is not None else typed | None, _described(model, name)]
    return inspect.Parameter(name, inspect.Parameter.KEYWORD_ONLY, default=default, annotation=annotation)


# Options of a run that other commands have too.
SceneArgument = Annotated[str, _described(RunOptions, "scene")]

SceneAvatarOption = Annotated[str | None, _described(RunOptions, "avatar")]

SceneSizeOption = Annotated[str | None, _described(RunOptions, "size")]

PerformanceProfileOption = typer.Option(help=RunOptions.model_fields["performance_profile"].description)

# An avatar and its network.
AvatarArgument = Annotated[str, typer.Argument(help=AVATARS_HELP)]

EncoderOption = Annotated[str, typer.Option(help=ENCODER_HELP)]

NormOption = Annotated[str, typer.Option(help=NORM_HELP)]

WidthOption = Annotated[int, typer.Option(help=WIDTH_HELP)]

FixedSizeOption = Annotated[str, typer.Option("--size", help=FIXED_SIZE_HELP)]

ChannelsOption = Annotated[int, typer.Option(help=f"Channels of the neural texture, 1 to {MAX_CHANNELS}.")]

FloatNetworkArgument = Annotated[Path, typer.Argument(help="Float network (.onnx) with the input N x C x H x W.")]

FramesFileOption = Annotated[Path, typer.Option("--frames", help="Real inputs: .npy (N, H, W, C) of floats.")]

METHOD_HELP = f"{either(CALIBRATION_METHODS)}."

# A body.
BODY_HELP = "Body file in the SMPL-X layout (.npz)."

BodyFileArgument = Annotated[Path, typer.Argument(help=BODY_HELP)]

BodyFileOption = Annotated[Path, typer.Option(help=BODY_HELP)]

# A hardware profile.
ProfileOption = Annotated[str, typer.Option("--profile", help=PROFILE_HELP)]
