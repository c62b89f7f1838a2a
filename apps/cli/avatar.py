"""`trilane avatar`: look into avatars and what they are trained on, train and validate them, quantise their networks.

Rule: this file lists the commands of the group; `avatar_create.py`, `avatar_data.py`, `avatar_train.py`,
`avatar_validate.py`, `avatar_network.py` and `avatar_quantise.py` hold the larger ones.
"""

from __future__ import annotations

from trilane.apps.cli import avatar_create, avatar_data, avatar_network, avatar_quantise, avatar_train, avatar_validate
from trilane.apps.cli.commands import Commands
from trilane.apps.cli.console import print_facts
from trilane.apps.cli.options import AvatarArgument, JsonOption

app = Commands(
    no_args_is_help=True,
    help="Look into avatars and captures, train and validate avatars, export and quantise their networks.",
)

EPILOG_INSPECT = "\b\nExamples:\n  trilane avatar inspect default\n  trilane avatar inspect my-avatar --json"


@app.command(epilog=EPILOG_INSPECT)
def inspect(name: AvatarArgument, json: JsonOption = False) -> None:
    """Say what an avatar holds and how good it is, after every check that a run makes."""
    from trilane.apps.avatar_facts import bundle_facts
    from trilane.avatars.bundle import load_bundle

    print_facts(bundle_facts(load_bundle(name)), json)


app.command(epilog=avatar_create.EPILOG_CREATE)(avatar_create.create)
app.command("create-data", epilog=avatar_data.EPILOG_CREATE)(avatar_data.create_data)
app.command("check-data", epilog=avatar_data.EPILOG_CHECK)(avatar_data.check_data)
app.command(epilog=avatar_train.EPILOG_TRAIN)(avatar_train.train)
app.command(epilog=avatar_validate.EPILOG_VALIDATE)(avatar_validate.validate)
app.command(epilog=avatar_network.EPILOG_NETWORK)(avatar_network.network)
app.command(epilog=avatar_quantise.EPILOG_QUANTISE)(avatar_quantise.quantise)
app.command("quantize", hidden=True)(avatar_quantise.quantise)  # the name that the command had first
app.command(epilog=avatar_quantise.EPILOG_CALIBRATIONS)(avatar_quantise.calibrations)
app.command(epilog=avatar_network.EPILOG_SPLIT)(avatar_network.split)
app.command(epilog=avatar_network.EPILOG_EXPORT)(avatar_network.export)
