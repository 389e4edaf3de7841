"""The command `plan network`: the precision that planned photographs will give."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from sfm.cli.options import Pdf, PlanOut
from sfm.cli.planning_inputs import (
    PlannedSetup,
    bars_of,
    camera_of,
    object_of,
    parse_numbers,
    stations_of,
    survey_plan,
)
from sfm.cli.process import loading
from sfm.model.errors import SurveyFileError
from sfm.runtime.faults import working_on

if TYPE_CHECKING:
    from sfm.model.camera import Camera
    from sfm.products.planning.visibility import DepthOfField

MAX_WEAK = 5  # weak points listed on the terminal


def plan_network(
    planned: Annotated[
        str,
        typer.Argument(
            metavar="OBJECT",
            help="Points (.csv: id,X,Y,Z[,nX,nY,nZ]), a mesh (.stl, .ply, .obj, .3mf), or box:LX,LY,LZ, "
            "cylinder:DIAMETER,HEIGHT, plate:LX,LY, wall:LENGTH,HEIGHT, dish:DIAMETER,DEPTH.",
        ),
    ],
    camera: Annotated[
        str | None,
        typer.Option(
            "--camera",
            metavar="CAMERA",
            help="Survey file, result folder, or a listed camera, such as full-frame-24.",
        ),
    ] = None,
    survey: Annotated[
        Path | None,
        typer.Option(
            "--survey",
            metavar="FILE.toml",
            help="Planned survey with cameras, rig, scale bars and survey observations, instead of --camera. "
            "The observed values in its tables are not used.",
        ),
    ] = None,
    free_mounts: Annotated[
        bool, typer.Option("--free-mounts", help="Estimate the mounts of the rig; they are not given.")
    ] = False,
    c: Annotated[
        float | None, typer.Option("--c-mm", metavar="MM", help="Principal distance (focal length), mm.")
    ] = None,
    camera_name: Annotated[
        str | None,
        typer.Option("--camera-name", metavar="NAME", help="Which camera, if --camera has several."),
    ] = None,
    free: Annotated[
        str | None,
        typer.Option("--free", metavar="P,Q,...", help="Camera parameters to adjust, or none."),
    ] = None,
    unit: Annotated[
        str, typer.Option("--unit", help="Unit of lengths: km, m, dm, cm, mm, um, nm, in or ft.")
    ] = "mm",
    points: Annotated[
        int,
        typer.Option(
            "--points", metavar="N", min=3, max=20000, help="Number of points on a mesh or a shape."
        ),
    ] = 200,
    open_mesh: Annotated[
        bool, typer.Option("--open-mesh", help="The mesh is an open surface, seen from outside.")
    ] = False,
    stations: Annotated[
        str | None,
        typer.Option(
            "--stations",
            metavar="STATIONS",
            help="CSV (image,X,Y,Z,omega_deg,phi_deg,kappa_deg) or ring:N, two-rings:N, hemisphere:N, "
            "strips:NxM, four-stations, left-right, front-back.  [default: designed for the wanted "
            "precision]",
        ),
    ] = None,
    sigma: Annotated[
        float | None, typer.Option("--sigma", metavar="S", help="Wanted sigma of every point.")
    ] = None,
    length_sigma: Annotated[
        float | None, typer.Option("--length-sigma", metavar="S", help="Wanted sigma of every length.")
    ] = None,
    displacement: Annotated[
        float | None,
        typer.Option(
            "--displacement", metavar="D", help="Smallest displacement to be detected between two surveys."
        ),
    ] = None,
    sigma_px: Annotated[
        float | None,
        typer.Option(
            "--sigma-px",
            metavar="PX",
            help="Standard deviation of an image coordinate, px.  [default: from the targets]",
        ),
    ] = None,
    diameter: Annotated[
        float | None, typer.Option("--target-diameter", metavar="D", help="Diameter of the targets.")
    ] = None,
    contrast: Annotated[
        float, typer.Option("--contrast", help="Difference of grey values between target and surroundings.")
    ] = 120.0,
    noise: Annotated[float, typer.Option("--noise", help="Standard deviation of a grey value.")] = 2.0,
    blur: Annotated[
        float, typer.Option("--blur-px", help="Blur of an edge, as a standard deviation, px.")
    ] = 0.8,
    incidence: Annotated[
        float,
        typer.Option(
            "--max-incidence-deg",
            metavar="DEG",
            help="Largest angle between a ray and the normal of a point, degrees.",
        ),
    ] = 60.0,
    f_number: Annotated[
        float | None,
        typer.Option("--f-number", metavar="N", help="F-number for the depth of field; needs --focus."),
    ] = None,
    focus: Annotated[
        float | None, typer.Option("--focus", metavar="D", help="Focus distance, in the unit of --unit.")
    ] = None,
    confusion: Annotated[
        float | None,
        typer.Option(
            "--confusion-um",
            metavar="UM",
            help="Diameter of the circle of confusion, um.  [default: two pixels]",
        ),
    ] = None,
    distance: Annotated[
        str | None,
        typer.Option("--distance", metavar="MIN,MAX", help="Allowed distances of stations from points."),
    ] = None,
    space: Annotated[
        str | None,
        typer.Option("--space", metavar="X0,X1,Y0,Y1,Z0,Z1", help="Region in which stations may lie."),
    ] = None,
    floor: Annotated[
        float | None, typer.Option("--floor", metavar="Z", help="Smallest Z of a station.")
    ] = None,
    photographs: Annotated[
        int,
        typer.Option("--photographs", metavar="N", min=4, max=1000, help="Largest number of photographs."),
    ] = 60,
    scale_bar: Annotated[
        list[str] | None,
        typer.Option(
            "--scale-bar",
            metavar="FROM,TO,SIGMA",
            help="Scale bar between two points and its sigma; may be given several times.",
        ),
    ] = None,
    out: PlanOut = Path("out/plan"),
    pdf: Pdf = False,
) -> None:
    """Predict the precision of a network, or design a network.

    Reports predicted standard deviations of the points, weak points with the reason, and whether the camera
    can be calibrated. Writes a page that shows the stations in space, and a list of the photographs to take.
    Lengths are in the unit of --unit.
    """
    with loading():
        import numpy as np

        from sfm.cli.console import exit_by, print_page, print_verdict
        from sfm.files.open_folders import refuse_foreign_folder
        from sfm.model.conventions import METRES
        from sfm.products.planning.designer import StationLimits, design_network
        from sfm.products.planning.page import figures
        from sfm.products.planning.plan import describe_plan, verdict_of_plan
        from sfm.products.planning.prediction import WantedPrecision, predict_network
        from sfm.products.planning.visibility import Seeing, TargetImage
        from sfm.report.pages import write_page
        from sfm.runtime.progress import StageClock
        from sfm.runtime.progress_bar import drawn_progress

    refuse_foreign_folder(out)
    if unit not in METRES:
        raise SurveyFileError(f"--unit {unit}: expected one of {', '.join(METRES)}")
    wanted = WantedPrecision(sigma, length_sigma, displacement)
    if stations is None and not wanted.anything:
        raise SurveyFileError(
            "plan: expected --stations, or a wanted precision by --sigma, --length-sigma or --displacement"
        )
    if sigma_px is None and diameter is None:
        raise SurveyFileError(
            "plan: expected --sigma-px or --target-diameter, which determine the precision of image points"
        )
    if (camera is None) == (survey is None):
        raise SurveyFileError("plan: expected either --camera or --survey")
    if survey is not None and any(option is not None for option in (c, camera_name, free)):
        raise SurveyFileError(f"--survey {survey}: --c-mm, --camera-name and --free belong to --camera")
    to_mm = METRES[unit] * 1000
    with working_on(planned), drawn_progress() as drawn, StageClock(drawn).stage("plan"):
        object_ = object_of(planned, points, open_mesh=open_mesh)
        if survey is not None:
            taken = survey_plan(survey, object_, unit, free_mounts=free_mounts)
        else:
            taken = PlannedSetup((camera_of(str(camera), camera_name, c, free),))
        reference = taken.reference
        depth = _depth_of_field(reference, f_number, focus, confusion, to_mm)
        seeing = Seeing(
            max_incidence_deg=incidence,
            diameter=diameter,
            depth=depth,
            sigma_px=sigma_px,
            target=TargetImage(contrast, noise, blur),
        )
        bars = (*taken.bars, *bars_of(scale_bar))
        name = Path(planned).stem if ":" not in planned else planned
        if stations is not None:
            placed = taken.photographs(stations_of(stations, object_, reference))
            prediction = predict_network(object_, taken.cameras, placed, seeing, bars=bars, given=taken.given)
            network_plan = describe_plan(name, unit, prediction, seeing, wanted)
        else:
            taken.refuse_to_design()
            least_and_most = box = None
            if distance is not None:
                least, most = parse_numbers("--distance", distance, 2)
                least_and_most = (least, most)
            if space is not None:
                box = np.array(parse_numbers("--space", space, 6)).reshape(3, 2).T
            allowed = StationLimits(least_and_most, box, floor, photographs)
            design = design_network(object_, reference, allowed, seeing, wanted, bars=bars, given=taken.given)
            network_plan = describe_plan(name, unit, design.prediction, seeing, wanted, design)
    page = write_page(network_plan, out)
    verdict = verdict_of_plan(network_plan)
    print_verdict(verdict)
    for what, value in figures(network_plan):
        print(f"  {what}: {value}")
    for weak in network_plan.weak[:MAX_WEAK]:
        print(f"  weak: point {weak.name}: {weak.reason}")
    if len(network_plan.weak) > MAX_WEAK:
        print(f"  ... and {len(network_plan.weak) - MAX_WEAK} more weak points, listed in the page")
    print_page("Report", page, pdf=pdf)
    exit_by(verdict)


def _depth_of_field(
    camera: Camera, f_number: float | None, focus: float | None, confusion_um: float | None, to_mm: float
) -> DepthOfField | None:
    """Return the depth of field in the object unit, or None if no f-number is given."""
    from sfm.products.planning.visibility import DepthOfField, Lens, depth_of_field

    if (f_number is None) != (focus is None):
        raise SurveyFileError("plan: the depth of field needs both --f-number and --focus")
    if f_number is None or focus is None:
        return None
    pixel = float(camera.pixel_mm.mean())
    confusion = 2 * pixel if confusion_um is None else confusion_um / 1000
    in_mm = depth_of_field(Lens(f_number, focus * to_mm, confusion), camera.c_px * pixel)
    return DepthOfField(in_mm.near / to_mm, in_mm.far / to_mm, focus)
