"""The typer application with all commands of kolinear. Each command imports its libraries when it runs."""

from __future__ import annotations

import platform
from functools import cache
from importlib.metadata import version
from typing import Annotated, Any

import typer

from sfm.cli.commands import batching, inspecting, measuring, planning, solvers, starting, surveying

USAGE_ERROR: Any = (
    typer.BadParameter.__base__
)  # base of typer's errors of arguments; typer does not export it

app = typer.Typer(
    name="kolinear",
    help="Close-range photogrammetry: targets, orientation, bundle adjustment and comparison with COLMAP.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
)


def _show_version(wanted: bool) -> None:
    """Print the versions that a bug report needs, and exit."""
    if wanted:
        print(f"kolinear {version('kolinear')}, Python {platform.python_version()}, {platform.platform()}")
        raise typer.Exit


@app.callback()
def _commands(
    version: Annotated[
        bool,
        typer.Option("--version", is_eager=True, callback=_show_version, help="Print the version and exit."),
    ] = False,
) -> None:
    """Take the options before a command."""


for _command in (
    surveying.run,
    surveying.init,
    surveying.adjust,
    batching.batch,
    measuring.resect,
    measuring.match,
    measuring.targets,
    inspecting.measure,
    inspecting.accept,
    solvers.compare,
    solvers.epochs,
    solvers.convert,
    solvers.refine,
    starting.doctor,
    inspecting.view,
):
    app.command()(_command)
planning.plan.command("simulate")(planning.simulate_command)
planning.plan.command("more")(planning.more_command)
app.add_typer(planning.plan)


@cache
def commands() -> Any:
    """Return the command line that typer builds from the application, which takes 0.1 s."""
    return typer.main.get_command(app)
