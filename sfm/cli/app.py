"""The commands of kolinear, put together; what they need is imported where they run."""

from __future__ import annotations

from typing import Any

import typer

from sfm.cli.commands import (
    batching,
    checking,
    comparing_epochs,
    drafting,
    inspecting,
    measuring,
    planning,
    planning_surveys,
    refining,
    solvers,
    surveying,
    viewing,
)

USAGE_ERROR: Any = typer.BadParameter.__base__  # of all that typer says of wrong arguments; it has no name

app = typer.Typer(
    name="kolinear",
    help="Close-range photogrammetry: targets, orientation, bundle adjustment, and COLMAP beside it.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
)


@app.callback()
def _commands() -> None:
    """Keep `kolinear` a command with subcommands."""


for _command in (
    surveying.run,
    drafting.init,
    surveying.adjust,
    batching.batch,
    measuring.resect,
    measuring.match,
    measuring.targets,
    inspecting.measure,
    inspecting.accept,
    solvers.validate,
    solvers.compare,
    comparing_epochs.epochs,
    solvers.convert,
    refining.refine,
    checking.doctor,
    viewing.view,
):
    app.command()(_command)
planning.plan.command("simulate")(planning_surveys.simulate_command)
planning.plan.command("more")(planning_surveys.more_command)
app.add_typer(planning.plan)
