"""Commands for solutions: compare, convert, epochs and refine."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from sfm.cli.commands.starting import FAILED, compile_first, loading
from sfm.model.display import counted
from sfm.model.errors import SurveyFileError
from sfm.runtime.faults import working_on

if TYPE_CHECKING:
    from sfm.products.epochs.differences import Epoch


def compare(
    a: Annotated[Path, typer.Argument(metavar="A", help="Result folder, COLMAP model, or another format.")],
    b: Annotated[Path, typer.Argument(metavar="B", help="Result to compare with A.")],
    align: Annotated[
        str, typer.Option("--align", help="Align B to A by points, cameras, control or none.")
    ] = "points",
    control: Annotated[
        str, typer.Option("--control", metavar="P,Q,R", help="Names of the points for --align control.")
    ] = "",
    a_format: Annotated[
        str | None, typer.Option("--from-a", metavar="F", help="Format of A.  [default: by its content]")
    ] = None,
    b_format: Annotated[
        str | None, typer.Option("--from-b", metavar="F", help="Format of B.  [default: by its content]")
    ] = None,
    out: Annotated[
        Path, typer.Option("--out", metavar="DIR", help="Folder for the table, JSON and page.")
    ] = Path("out/comparison"),
) -> None:
    """Compare two results.

    Reports differences, their standard deviations, and which differences are significant.
    """
    with loading():
        from adapters.formats.registry import read_comparable
        from sfm.cli.console import exit_by, print_verdict
        from sfm.comparison.findings import verdict_of_comparison
        from sfm.comparison.significance import compare_results
        from sfm.files.open_folders import refuse_foreign_folder
        from sfm.report.differences import describe_pairing, describe_scale, largest_difference
        from sfm.report.pages import write_page

    refuse_foreign_folder(out)
    with working_on(str(a)):
        first = read_comparable(a, a_format)
    with working_on(str(b)):
        second = read_comparable(b, b_format)
    if first.name == second.name:
        first, second = replace(first, name=str(a)), replace(second, name=str(b))
    names = tuple(name.strip() for name in control.split(",") if name.strip())
    comparison = compare_results(first, second, align=align, control=names)
    place = {name: j for j, name in enumerate(first.network.points)}
    xyz = first.estimate.points[[place[name] for name in comparison.points]]
    page = write_page(comparison, out, xyz=xyz)
    print(
        f"{describe_pairing(comparison)}, {counted(len(comparison.images), 'common photograph')}; "
        f"{describe_scale(comparison)}"
    )
    verdict = verdict_of_comparison(comparison)
    print_verdict(verdict)
    if comparison.points:
        print(f"largest difference of a point: {largest_difference(comparison)}")
    print(f"Report: {page}")
    exit_by(verdict)


def convert(
    source: Annotated[Path, typer.Argument(metavar="IN", help="File or folder to read.")],
    target: Annotated[Path, typer.Argument(metavar="OUT", help="File or folder to write.")],
    to_format: Annotated[
        str | None,
        typer.Option(
            "--to",
            metavar="F",
            help="Format to write.  [default: by the ending of OUT: .xml metashape, .ply ply, .db "
            "colmap-database, none tables]",
        ),
    ] = None,
    from_format: Annotated[
        str | None,
        typer.Option("--from", metavar="F", help="Format to read.  [default: by the content of IN]"),
    ] = None,
    straighten: Annotated[
        bool,
        typer.Option(
            "--undistort", help="Correct image points for distortion, for formats without distortion."
        ),
    ] = False,
    control: Annotated[
        Path | None,
        typer.Option(
            "--control", metavar="FILE", help="Control points of a PhotoModeler export: id,label,X,Y,Z..."
        ),
    ] = None,
) -> None:
    """Convert a survey from one program's format to another's.

    A camera whose model the format lacks is converted to one that it has. Formats: colmap, colmap-text,
    colmap-database, tables, metashape, photomodeler, bal, sba, bundle-matlab, bundle-csharp, rig (calibration
    files of rigs for OpenCV, COLMAP, DICe, MatchID, Kalibr, ROS and mrcal) and ply.
    """
    with loading():
        from adapters.formats.content import with_cameras
        from adapters.formats.registry import (
            ENDINGS,
            FORMATS,
            describe_stored,
            format_named,
            losses_in_words,
            read_content,
            refuse_taken,
            write_content,
        )
        from sfm.comparison.camera_conversion import Conversion, convert_cameras, undistort

    ending = target.suffix.lower()
    if to_format is None and ending and ending not in ENDINGS:
        raise SurveyFileError(
            f"{target}: unknown ending {ending}, expected {', '.join(ENDINGS)}, a folder for tables, or --to "
            f"with one of {', '.join(known.name for known in FORMATS)}"
        )
    form = format_named(to_format or ENDINGS.get(ending, "tables"))
    refuse_taken(target, form)
    with working_on(str(source)):
        content = read_content(source, from_format, control=control)
    network, estimate = content.result.network, content.result.estimate
    cameras = estimate.cameras
    conversions: tuple[Conversion, ...] = ()
    if form.models:
        if straighten:
            network, estimate = undistort(network, estimate, form.models)
        estimate, conversions = convert_cameras(estimate, form.models, held=form.lacks)
    changed, gone = with_cameras(content, network, estimate)
    changed = replace(changed, result=replace(changed.result, name=target.name))
    write_content(target, form.name, changed)
    for camera, conversion in zip(cameras, conversions, strict=False):
        if straighten:
            print(f"camera {camera.name}: image points corrected for {camera.model}, ideal camera written")
        elif conversion.camera is not camera:
            print(
                f"camera {camera.name}: {conversion.source_model} to {conversion.camera.model}, "
                f"misfit {conversion.rms_px:.4f} px RMS, {conversion.max_px:.4f} px at most"
            )
    for note in content.notes:
        print(f"{source}: {note}")
    print(f"{target}: {describe_stored(form.name, network, estimate)} as {form.name}")
    for loss in losses_in_words(form.name, content, gone):
        print(f"{target}: {loss} left out, format {form.name} cannot store them")


def epochs(
    results: Annotated[
        list[Path],
        typer.Argument(
            metavar="FIRST SECOND ...",
            help="Result folders in chronological order. A survey file is run first, with its result in "
            "out/NAME.",
        ),
    ],
    reference: Annotated[
        str,
        typer.Option(
            "--reference",
            metavar="P,Q,...",
            help="Points assumed stable until a test shows otherwise: names, patterns such as R*, ranges "
            "such as 501-520.  [default: all]",
        ),
    ] = "",
    group: Annotated[
        list[str] | None,
        typer.Option(
            "--group",
            metavar="NAME=P,Q,...",
            help="Points whose motion as one block is estimated; may be given several times.",
        ),
    ] = None,
    model: Annotated[
        str, typer.Option("--model", help="Motion of a group: rigid, similarity or affine.")
    ] = "rigid",
    alpha: Annotated[
        float | None,
        typer.Option(
            "--alpha",
            min=1e-6,
            max=0.5,
            help="Probability of reporting a motion where nothing moved; as for a survey if left out.",
        ),
    ] = None,
    together: Annotated[
        bool,
        typer.Option(
            "--together",
            help="Adjust all epochs together, with one interior orientation for each camera that took "
            "several of them; a camera that changed between epochs is refused.",
        ),
    ] = False,
    out: Annotated[
        Path, typer.Option("--out", metavar="DIR", help="Folder for the tables, JSON and page.")
    ] = Path("out/epochs"),
) -> None:
    """Find what moved between surveys of one object.

    Reports the congruency test, the stable points, displacements with their tests, and motions of groups.
    """
    with loading():
        from sfm.cli.console import exit_by, print_verdict
        from sfm.files.open_folders import refuse_foreign_folder
        from sfm.model.distributions import FALSE_ALARM
        from sfm.products.epochs.page import describe_block, describe_stable
        from sfm.products.epochs.series import analyse_epochs, verdict_of_epochs
        from sfm.report.pages import write_page

    refuse_foreign_folder(out)
    if len(results) < 2:
        raise SurveyFileError(f"epochs: {len(results)} given, expected 2 or more")
    groups: dict[str, list[str]] = {}
    for name, points in map(_parse_group, group or ()):
        if name in groups:
            raise SurveyFileError(f"--group {name} is given twice")
        groups[name] = _split_names(points)
    for k, path in enumerate(results):
        if path.resolve() in [earlier.resolve() for earlier in results[:k]]:
            raise SurveyFileError(f"epochs: {path} is given twice")
    given = [_read_epoch(path) for path in results]
    if len({epoch.name for epoch in given}) < len(given):  # folders of the same name in different folders
        given = [replace(epoch, name=str(path)) for epoch, path in zip(given, results, strict=True)]
    with working_on(" ".join(map(str, results))):
        series = analyse_epochs(
            given,
            reference=_split_names(reference),
            groups=groups,
            model=model,
            alpha=FALSE_ALARM if alpha is None else alpha,
            together=together,
        )
    page = write_page(series, out)
    verdict = verdict_of_epochs(series)
    print_verdict(verdict)
    for pair in series.pairs:
        print(" to ".join(pair.displacements.differences.names))
        print(f"  {describe_stable(pair.displacements)}")
        for block in pair.blocks:
            print(f"  {describe_block(block)}")
    print(f"Report: {page}")
    exit_by(verdict)


def _read_epoch(path: Path) -> Epoch:
    """Return the epoch of a result folder, or of a survey file, which is run first."""
    from adapters.formats.control_tables import read_given
    from adapters.formats.result_tables import read_result
    from sfm.cli.commands.surveying import run_file
    from sfm.products.epochs.differences import Epoch

    folder = run_file(path) if path.is_file() else path
    with working_on(str(folder)):
        result = read_result(folder)
        given = read_given(folder, result.network)
    name = folder.resolve().name
    return Epoch(name, result, given.bars, given.control, given.interior, given.sigma0, given.sigma0_px)


def _parse_group(text: str) -> tuple[str, str]:
    name, equals, points = text.partition("=")
    if not (name.strip() and equals and points.strip()):
        raise SurveyFileError(f"--group {text}: expected a name and its points, such as pier=P*,17")
    return name.strip(), points


def _split_names(text: str) -> list[str]:
    return [part.strip() for part in text.split(",") if part.strip()]


def refine(
    model: Annotated[Path, typer.Argument(metavar="COLMAP_MODEL", help="Folder of cameras, images, points.")],
    images: Annotated[Path, typer.Option("--images", metavar="DIR", help="Folder of its photographs.")],
    out: Annotated[
        Path | None,
        typer.Option(
            "--out", metavar="DIR", help="New folder for the refined model.  [default: beside the model]"
        ),
    ] = None,
    window: Annotated[
        int | None,
        typer.Option(
            "--window",
            metavar="N",
            help="Width of the windows, odd, 3 to 101 px.  [default: 15 or 11, whichever measures better]",
        ),
    ] = None,
    min_correlation: Annotated[
        float,
        typer.Option(
            "--min-correlation",
            metavar="R",
            help="Smallest correlation coefficient r between a window and its template, 0 to 1.",
        ),
    ] = 0.7,
    fix: Annotated[
        str,
        typer.Option(
            "--fix", metavar="NAMES", help="Interior parameters to hold fixed, such as f,fx,fy,cx,cy,k1."
        ),
    ] = "",
    masks: Annotated[
        Path | None,
        typer.Option(
            "--masks", metavar="DIR", help="Folder of masks, NAME.png for photograph NAME; black is ignored."
        ),
    ] = None,
    survey: Annotated[
        Path | None,
        typer.Option(
            "--survey",
            metavar="FILE",
            help="Survey file with coded targets, control and scale bars to add to the model.",
        ),
    ] = None,
) -> None:
    """Remeasure the key points of a COLMAP model.

    Key points are measured by least squares matching, then the model is adjusted again. The new model keeps
    identifiers, colours, camera models, rigs and points with two rays. Its folder has a page,
    refinement.html, and the standard deviations of points, photographs and cameras (sigma_*.csv).

    The principal point is also estimated if a camera took four or more photographs; hold it fixed with
    --fix cx,cy. With a survey file, the coded targets that it describes are measured and adjusted with the
    key points; its control and scale bars define the frame and scale of the model.
    """
    with loading():
        from adapters.colmap.camera_models import write_scene
        from adapters.colmap.refined_model import (
            interior_rows,
            key_points_of,
            open_model,
            place_model,
            update_model,
        )
        from sfm.files.whole_files import refuse_unwritable, whole_folder
        from sfm.products.refining.oriented_windows import measure_model_targets
        from sfm.products.refining.page import Numbers, describe_key_points
        from sfm.products.refining.refinement import RefineSettings, refine_model, refinement_text
        from sfm.report.pages import page_of, texts_of
        from sfm.runtime.progress_bar import drawn_progress
        from sfm.survey.inputs.settings import AdjustSettings
        from sfm.survey.inputs.survey import read_survey

    out = model.resolve().with_name(f"{model.resolve().name}_refined") if out is None else out
    refuse_unwritable(out)
    with working_on(str(model)):
        opened = open_model(model)
        given = None if survey is None else read_survey(survey)
    compile_first()
    with working_on(str(model)), drawn_progress() as progress:
        targets = None
        if given is not None:
            targets = measure_model_targets(given, opened.network, opened.estimate, images, progress=progress)
            opened, targets = place_model(opened, targets.placement), targets.placed()
        refinement = refine_model(
            opened.network,
            opened.estimate,
            images,
            RefineSettings(
                window,
                min_correlation,
                fixed=tuple(name.strip() for name in fix.split(",") if name.strip()),
                masks_dir=masks,
                false_alarm=(AdjustSettings() if given is None else given.adjust).false_alarm,
            ),
            targets=targets,
            progress=progress,
        )
    a = refinement.adjustment
    interior = interior_rows(opened, refinement.start, refinement.estimate, a.covariance.interior)
    update_model(
        opened,
        refinement.estimate,
        xy=refinement.xy,
        measured=refinement.accepted,
        images=refinement.images,
        points=refinement.points_anew,
    )
    numbers = Numbers(opened.image_ids, opened.point_ids, interior, *key_points_of(opened))
    print(refinement_text(refinement), end="")
    page = page_of(refinement, numbers=numbers, title=model.resolve().name)
    with whole_folder(out) as folder:
        write_scene(folder, opened.scene)
        for name, text in texts_of(page).items():
            (folder / name).write_text(text, encoding="utf-8")
    print(describe_key_points(refinement, numbers))
    print(f"Model: {out}")
    print(f"Report: {out / 'refinement.html'}")
    if not refinement.dependable:
        raise SystemExit(FAILED)
