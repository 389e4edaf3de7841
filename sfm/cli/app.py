"""The command line: a row of each command, and the typer application made of them.

A command is a function in a module of its own in `sfm.cli.commands`, and imports its libraries when it runs.
The list of commands in README.md (`python docs/command_list.py README.md`), the reference and the tests of
exit codes follow from the rows.
"""

from __future__ import annotations

import platform
from collections.abc import Callable
from functools import cache
from importlib.metadata import version
from typing import Annotated, Any, NamedTuple

import typer

from sfm.cli.commands.accept import accept
from sfm.cli.commands.adjust import adjust
from sfm.cli.commands.batch import batch
from sfm.cli.commands.calibrate import calibrate
from sfm.cli.commands.compare import compare
from sfm.cli.commands.convert import convert
from sfm.cli.commands.doctor import doctor
from sfm.cli.commands.epochs import epochs
from sfm.cli.commands.georeference import georeference
from sfm.cli.commands.init import init
from sfm.cli.commands.mark import mark
from sfm.cli.commands.match import match
from sfm.cli.commands.measure import measure
from sfm.cli.commands.orient_absolute import orient_absolute
from sfm.cli.commands.orient_correct import orient_correct
from sfm.cli.commands.orient_fiducials import orient_fiducials
from sfm.cli.commands.orient_pair import orient_pair
from sfm.cli.commands.plan_more import plan_more
from sfm.cli.commands.plan_network import plan_network
from sfm.cli.commands.plan_simulate import plan_simulate
from sfm.cli.commands.plan_target_size import plan_target_size
from sfm.cli.commands.refine import refine
from sfm.cli.commands.resect import resect
from sfm.cli.commands.run import run
from sfm.cli.commands.targets import targets
from sfm.cli.commands.undistort import undistort
from sfm.cli.commands.view import view


class Command(NamedTuple):
    """A command."""

    words: str  # that follow `kolinear`: the name, or the names of a group and of a command in it
    function: Callable[..., None]  # that typer calls with the options; its docstring is the help
    usage: str  # arguments in the list of commands
    purpose: str  # in the list of commands


COMMANDS = (
    Command("run", run, "PHOTOS|VIDEO|SURVEY.toml", "photographs -> report"),
    Command("init", init, "PHOTOS|VIDEO", "draft the survey file of a folder of photographs"),
    Command("calibrate", calibrate, "PHOTOS", "a camera, how far to trust it, and which photograph next"),
    Command("adjust", adjust, "SURVEY.toml", "measured image points -> report"),
    Command("batch", batch, "SURVEYS...", "many surveys, on this computer or a cluster"),
    Command("targets", targets, "--out sheet.pdf", "coded targets or tags to print"),
    Command("plan network", plan_network, "OBJECT --camera CAMERA", "what planned photographs will give"),
    Command("plan simulate", plan_simulate, "PLAN", "render a plan, run it and compare"),
    Command("plan more", plan_more, "RESULT", "photographs to add to a survey"),
    Command("plan target-size", plan_target_size, "--distance D ...", "how large targets must be"),
    Command("resect", resect, "POINTS.csv --c MM", "one photograph on known points"),
    Command("orient fiducials", orient_fiducials, "MARKS.csv", "measured -> photo coordinates"),
    Command("orient correct", orient_correct, "POINTS.csv --c MM", "corrections of photo coordinates"),
    Command("orient pair", orient_pair, "LEFT.csv RIGHT.csv --c MM", "relative orientation and model"),
    Command("orient absolute", orient_absolute, "MODEL.csv CONTROL.csv", "a model onto control points"),
    Command(
        "georeference",
        georeference,
        "PHOTO CONTROL.csv",
        "a flat object's photograph onto its control points",
    ),
    Command("mark", mark, "PHOTOS|SURVEY|RESULT", "measure points by hand, in the browser"),
    Command("match", match, "LEFT RIGHT", "conjugate points of two photographs"),
    Command("compare", compare, "A B", "two results or cameras: differences and their significance"),
    Command("epochs", epochs, "FIRST SECOND", "what moved between surveys of one object"),
    Command("measure", measure, "RESULT", "shapes, distances, alignment, tolerances"),
    Command("accept", accept, "RESULT LENGTHS.csv", "calibrated lengths, VDI/VDE 2634 part 1"),
    Command("view", view, "FOLDER", "a result or a COLMAP model as one page to explore"),
    Command("refine", refine, "MODEL --images DIR", "re-measure the key points of a COLMAP model, adjust"),
    Command("convert", convert, "IN OUT", "carry a survey or its cameras between programs"),
    Command(
        "undistort", undistort, "RESULT|CAMERA PHOTOS", "photographs without distortion, rectified pairs"
    ),
    Command("doctor", doctor, "", "versions, folders, and whether this installation measures"),
)
PURPOSE = "Close-range photogrammetry: targets, orientation, bundle adjustment and comparison with COLMAP."
GROUPS = {
    "plan": "Plan a survey before the photographs are taken.",
    "orient": "Orient one or two photographs step by step, from tables of coordinates.",
}

USAGE_ERROR: Any = (
    typer.BadParameter.__base__
)  # base of typer's errors of arguments; typer does not export it


def _show_version(wanted: bool) -> None:
    """Print the versions that a bug report needs, and exit."""
    if wanted:
        print(f"kolinear {version('kolinear')}, Python {platform.python_version()}, {platform.platform()}")
        raise typer.Exit


def _application() -> typer.Typer:
    """Return the application with all commands."""
    made = typer.Typer(
        name="kolinear",
        help=PURPOSE,
        no_args_is_help=True,
        add_completion=False,
        pretty_exceptions_enable=False,
        rich_markup_mode=None,
    )

    @made.callback()
    def _kolinear(
        version: Annotated[
            bool,
            typer.Option(
                "--version", is_eager=True, callback=_show_version, help="Print the version and exit."
            ),
        ] = False,
    ) -> None:
        """Take the options before a command."""

    groups = {name: typer.Typer(name=name, help=purpose) for name, purpose in GROUPS.items()}
    for command in COMMANDS:
        group, _, name = command.words.rpartition(" ")
        (groups[group] if group else made).command(name)(command.function)
    for made_group in groups.values():
        made.add_typer(made_group)
    return made


app = _application()


@cache
def commands() -> Any:
    """Return the command line that typer builds from the application, which takes 0.1 s."""
    return typer.main.get_command(app)
