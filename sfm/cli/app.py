"""The command line: a row of each command, and the typer application made of them.

A command is a function in a module of its own in `sfm.cli.commands`, and imports its libraries when it runs.
The list of commands in README.md (`python docs/command_list.py README.md`), the reference and the tests of
exit codes follow from the rows.
"""

from __future__ import annotations

import platform
import sys
from collections.abc import Callable
from functools import cache
from importlib.metadata import version
from typing import Annotated, Any, NamedTuple

import typer
from typer.core import TyperGroup

from sfm.cli.commands.accept import accept
from sfm.cli.commands.adjust import adjust
from sfm.cli.commands.audit import audit
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
    task: str  # under which the help lists it


MEASURE, JUDGE, PLAN, EXCHANGE, CHECK = (
    "Measure",
    "Judge a result",
    "Plan",
    "Exchange with other programs",
    "Check",
)
COMMANDS = (
    Command("run", run, "PHOTOS|VIDEO|SURVEY.toml", "photographs -> report", MEASURE),
    Command("init", init, "PHOTOS|VIDEO", "draft the survey file of a folder of photographs", MEASURE),
    Command(
        "calibrate", calibrate, "PHOTOS", "a camera, how far to trust it, and which photograph next", MEASURE
    ),
    Command("adjust", adjust, "SURVEY.toml", "measured image points -> report", MEASURE),
    Command("batch", batch, "SURVEYS...", "many surveys, on this computer or a cluster", MEASURE),
    Command("mark", mark, "PHOTOS|SURVEY|RESULT", "measure points by hand, in the browser", MEASURE),
    Command("match", match, "LEFT RIGHT", "conjugate points of two photographs", MEASURE),
    Command("resect", resect, "POINTS.csv --c MM", "one photograph on known points", MEASURE),
    Command("orient fiducials", orient_fiducials, "MARKS.csv", "measured -> photo coordinates", MEASURE),
    Command(
        "orient correct", orient_correct, "POINTS.csv --c MM", "corrections of photo coordinates", MEASURE
    ),
    Command(
        "orient pair", orient_pair, "LEFT.csv RIGHT.csv --c MM", "relative orientation and model", MEASURE
    ),
    Command(
        "orient absolute", orient_absolute, "MODEL.csv CONTROL.csv", "a model onto control points", MEASURE
    ),
    Command(
        "georeference",
        georeference,
        "PHOTO CONTROL.csv",
        "a flat object's photograph onto its control points",
        MEASURE,
    ),
    Command(
        "refine", refine, "MODEL --images DIR", "re-measure the key points of a COLMAP model, adjust", MEASURE
    ),
    Command("measure", measure, "RESULT", "shapes, distances, alignment, tolerances", JUDGE),
    Command("compare", compare, "A B", "two results or cameras: differences and their significance", JUDGE),
    Command("epochs", epochs, "FIRST SECOND", "what moved between surveys of one object", JUDGE),
    Command("view", view, "FOLDER", "a result or a COLMAP model as one page to explore", JUDGE),
    Command("audit", audit, "MODEL", "a model of another program, judged by its image points", JUDGE),
    Command("targets", targets, "--out sheet.pdf", "coded targets or tags to print", PLAN),
    Command(
        "plan network", plan_network, "OBJECT --camera CAMERA", "what planned photographs will give", PLAN
    ),
    Command("plan simulate", plan_simulate, "PLAN", "render a plan, run it and compare", PLAN),
    Command("plan more", plan_more, "RESULT", "photographs to add to a survey", PLAN),
    Command("plan target-size", plan_target_size, "--distance D ...", "how large targets must be", PLAN),
    Command("convert", convert, "IN OUT", "carry a survey or its cameras between programs", EXCHANGE),
    Command(
        "undistort",
        undistort,
        "RESULT|CAMERA PHOTOS",
        "photographs without distortion, rectified pairs",
        EXCHANGE,
    ),
    Command("accept", accept, "RESULT LENGTHS.csv", "calibrated lengths, VDI/VDE 2634 part 1", CHECK),
    Command("doctor", doctor, "", "versions, folders, and whether this installation measures", CHECK),
)
PURPOSE = "Close-range photogrammetry: targets, orientation, bundle adjustment and comparison with COLMAP."
BEGIN = """\
Kolinear measures objects and cameras from photographs. To begin:

  kolinear run PHOTOS                photographs or a video, to a report in out/
  kolinear targets --out sheet.pdf   coded targets to print and photograph too
  kolinear doctor                    whether this installation measures

All commands: kolinear --help. One of them: kolinear run --help.
"""  # without a command
WITHOUT_COMMAND = 2  # exit code
GROUPS = {
    "plan": "Plan a survey before the photographs are taken.",
    "orient": "Orient photographs step by step, from tables of coordinates.",
}

USAGE_ERROR: Any = (
    typer.BadParameter.__base__
)  # base of typer's errors of arguments; typer does not export it


class _GroupedByTask(TyperGroup):
    """The commands, whose help lists them by the task that they are for."""

    def format_commands(self, ctx: Any, formatter: Any) -> None:
        """Write a section of the help for each task."""
        tasks = {command.words.partition(" ")[0]: command.task for command in COMMANDS}
        room = formatter.width - 6 - max(map(len, tasks))
        for task in dict.fromkeys(tasks.values()):
            names = [name for name in tasks if tasks[name] == task]
            with formatter.section(task):
                formatter.write_dl([(name, self.commands[name].get_short_help_str(room)) for name in names])


def _show_version(wanted: bool) -> None:
    """Print the versions that a bug report needs, and exit."""
    if wanted:
        print(f"kolinear {version('kolinear')}, Python {platform.python_version()}, {platform.platform()}")
        raise typer.Exit


def _application() -> typer.Typer:
    """Return the application with all commands."""
    made = typer.Typer(
        name="kolinear",
        cls=_GroupedByTask,
        help=PURPOSE,
        pretty_exceptions_enable=False,
        rich_markup_mode=None,
    )

    @made.callback(invoke_without_command=True)
    def _kolinear(
        context: typer.Context,
        version: Annotated[
            bool,
            typer.Option(
                "--version", is_eager=True, callback=_show_version, help="Print the version and exit."
            ),
        ] = False,
    ) -> None:
        """Take the options before a command; without one, say how to begin."""
        if context.invoked_subcommand is None:
            print(BEGIN, file=sys.stderr, end="")
            raise typer.Exit(WITHOUT_COMMAND)

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
