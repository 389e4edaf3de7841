"""The command `mark`: measure points by hand in the browser, with the program's help."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from sfm.cli.options import AllowOutside, OpenPage
from sfm.cli.process import compile_first, loading
from sfm.model.display import counted
from sfm.model.errors import KolinearError, MissingLibraryError
from sfm.runtime.faults import working_on

if TYPE_CHECKING:
    from sfm.products.marking.project import MarkedProject

MARKS = "-marks.csv"  # after the name of a survey file or of a folder of photographs


def mark(
    source: Annotated[
        Path,
        typer.Argument(
            metavar="PHOTOS|SURVEY|RESULT", help="Folder of photographs, survey file, or result folder."
        ),
    ],
    images: Annotated[
        Path | None,
        typer.Option(
            "--images",
            metavar="DIR",
            help="Folder of the photographs.  [default: that of the survey file]",
        ),
    ] = None,
    out: Annotated[
        Path | None,
        typer.Option(
            "--out",
            metavar="MARKS.csv",
            help="Marks file; an earlier one is continued.  [default: that of the survey file, or "
            "SURVEY-marks.csv beside it, or out/NAME-marks.csv]",
        ),
    ] = None,
    import_from: Annotated[
        Path | None,
        typer.Option(
            "--import",
            metavar="FILE",
            help="Add the marks of another program: ground_control_points.json, gcp_list.txt, Metashape's "
            ".xml or COLMAP's .db.",
        ),
    ] = None,
    export_to: Annotated[
        Path | None,
        typer.Option(
            "--export",
            metavar="FILE",
            help="Write the marks for another program as .json (OpenSfM), .txt (OpenDroneMap), .xml "
            "(Metashape) or .db (COLMAP), and end without a page.",
        ),
    ] = None,
    port: Annotated[
        int,
        typer.Option(
            "--port", metavar="N", min=0, max=65535, help="Port of the page.  [default: a free one]"
        ),
    ] = 0,
    browser: OpenPage = True,
    allow_outside: AllowOutside = False,
) -> None:
    """Measure points by hand, in the browser.

    A click measures what is there, and the page says what comes next. It is served on this computer only,
    until Ctrl-C. Every mark is saved at once.
    """
    with loading():
        import webbrowser

        try:
            from sfm.products.marking.server import MarkingServer
        except ModuleNotFoundError as error:
            if error.name not in ("starlette", "uvicorn"):
                raise
            raise MissingLibraryError(
                f"mark: {error.name} is not installed; install it with: pip install 'kolinear[mark]'"
            ) from None
        from sfm.files.user_cache import scratch_folder
        from sfm.products.marking.session import MarkingSession

    compile_first()
    with working_on(str(source)):
        project, marks, control = _project(source, images, allow_outside=allow_outside)
        session = MarkingSession(project, out or marks)
    try:
        said = ""
        if import_from is not None:
            from sfm.cli.other_marks import read_marks_of_others

            names, sizes = project.photographs.names, project.sizes
            with working_on(str(import_from)):
                added = session.add(read_marks_of_others(import_from, names, sizes, project.survey.unit))
            said = f"{import_from}: {counted(added, 'mark')} added\n"
        if export_to is not None:
            from sfm.cli.other_marks import write_marks_of_others

            with working_on(str(export_to)):
                network, estimate = session.exported()
                given = [file for file in (import_from, control) if file and file.suffix == export_to.suffix]
                before = next(iter(given), None)
                count = write_marks_of_others(export_to, network, estimate, ground_control=before)
            left = len(network.image_points) - count
            without = f", {left} of points without coordinates in {before} left out" if left else ""
            print(f"{said}{export_to}: {counted(count, 'mark')}{without}")
            return
        server = MarkingServer(session, port)
        print(f"{said}Marks: {out or marks}")
        print(f"Page: {server.address.url}", flush=True)
        with scratch_folder() as folder:
            # a file that only this user can read: all users see the command line of the browser
            start = folder / "start.html"
            start.touch(mode=0o600)
            start.write_text(f'<meta http-equiv="refresh" content="0; url={server.address.url}">', "utf-8")
            if browser and not webbrowser.open(start.as_uri()):
                print("No browser could be opened; open the page yourself.", flush=True)
            print("Ctrl-C ends it; every mark is saved.", flush=True)
            server.serve()
    finally:
        session.close()


def _project(
    source: Path, images: Path | None, *, allow_outside: bool
) -> tuple[MarkedProject, Path, Path | None]:
    """Return what is marked, its marks file if none is named, and its file of control if it has one."""
    from adapters.formats.result_tables import read_result
    from sfm.cli.survey_runs import SURVEY_FILE
    from sfm.files.globs import nearest_name
    from sfm.library.surveys import sensor_widths
    from sfm.products.drafting.draft import names_of_folder
    from sfm.products.marking.project import project_of_folder, project_of_survey
    from sfm.report.output import folder_name, read_origin
    from sfm.survey.inputs.named_folders import named_folder
    from sfm.survey.inputs.survey import survey_of_file
    from sfm.survey.inputs.survey_file import read_survey_file

    if not source.exists():
        raise KolinearError(f"{source}: neither a survey file nor a folder{nearest_name(source)}")
    solution, survey_file, photographs = None, source, None
    if source.is_dir() and (source / "cameras.csv").is_file():
        origin = read_origin(source)
        if origin is None:
            raise KolinearError(f"{source}: does not state the survey that it is the result of")
        solution, survey_file, photographs = read_result(source), origin.file, images or origin.images
    elif source.is_dir() and (source / SURVEY_FILE).is_file():
        survey_file = source / SURVEY_FILE
    elif source.is_dir():
        name = folder_name(next(names_of_folder(source)))
        return project_of_folder(source, sensor_widths(lambda _: None)), Path("out") / f"{name}{MARKS}", None
    described = read_survey_file(survey_file, allow_outside=allow_outside)
    marks = survey_file.with_name(f"{survey_file.stem}{MARKS}")
    if described.marked is not None:  # the session reads them itself
        marks = described.beside(described.marked.file)
        described = described.model_copy(update={"marked": None})
    project = project_of_survey(
        survey_of_file(described),
        images_dir=photographs or named_folder(described, images),
        survey_file=survey_file,
        solution=solution,
    )
    control = described.control
    return project, marks, None if control is None else described.beside(control.file)
