"""The command `audit`: a model of any program, judged by its own image points."""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path
from typing import Annotated

import typer

from sfm.cli.options import Overwrite, Pdf, names_in
from sfm.cli.process import compile_first, loading
from sfm.cli.survey_runs import lock_folder, reporting_unfinished
from sfm.runtime.faults import working_on

SHOWN = 4  # sections of the page whose tables are printed
# of what a format may have, by its names in `adapters.formats.content`
NOT_USED = (
    "exterior", "interior", "checks", "rejected", "image covariances", "shared", "unplaced",
)  # fmt: skip


def audit(
    model: Annotated[Path, typer.Argument(metavar="MODEL", help="File or folder of another program.")],
    from_format: Annotated[
        str | None,
        typer.Option("--from", metavar="F", help="Format of the model.  [default: by its content]"),
    ] = None,
    survey: Annotated[
        Path | None,
        typer.Option(
            "--survey",
            metavar="FILE",
            help="Survey file with cameras, rigs, control, scale bars and tables for the model.",
        ),
    ] = None,
    fix: Annotated[
        str,
        typer.Option("--fix", metavar="NAMES", help="Interior parameters to hold fixed, such as cx,cy,k1."),
    ] = "",
    one_camera: Annotated[
        bool,
        typer.Option("--one-camera", help="Join cameras of one size and lens model into one."),
    ] = False,
    out: Annotated[
        Path | None,
        typer.Option("--out", metavar="DIR", help="Folder of the result.  [default: out/NAME_audit]"),
    ] = None,
    overwrite: Overwrite = False,
    pdf: Pdf = False,
) -> None:
    """Judge a model of another program by its own image points.

    The model is adjusted from its image points, without photographs, and held against what it states: whether
    its cameras are determined, how precise its points are, gross errors, what the datum does. The folder has
    a page, audit.html, and the full report of the adjustment.

    Exit code 0 with a dependable result, with or without remarks; 1 if the result is not dependable, for the
    reasons on the page, or a stage cannot go on; 2 if the input must be corrected.
    """
    with loading():
        from adapters.formats.content import ALL, losses
        from adapters.formats.registry import read_content
        from sfm.cli.console import exit_by, print_page, print_verdict
        from sfm.files.globs import name_of_model
        from sfm.files.open_folders import refuse_foreign_folder
        from sfm.model.display import listed
        from sfm.pipeline import run_survey
        from sfm.products.auditing.audit import audit_of, stated_of, survey_of_model
        from sfm.products.auditing.prepared import prepared_model
        from sfm.report.findings import findings_of
        from sfm.report.output import (
            Origin,
            SurveyLog,
            folder_name,
            refuse_other_origin,
            write_result,
        )
        from sfm.report.pages import page_of, texts_of
        from sfm.runtime.forecast import Run, RunHistory, forecast
        from sfm.runtime.memory import peak_bytes
        from sfm.runtime.progress_bar import drawn_progress
        from sfm.runtime.threads import cores, one_blas_thread
        from sfm.survey.inputs.measurements import NO_PHOTOGRAPHS, work_of
        from sfm.survey.inputs.survey import read_survey

    with working_on(str(model)):
        content = read_content(model, from_format)
        stated_model = replace(content.result, name=name_of_model(model))
        stated_model, added = prepared_model(stated_model, one_camera=one_camera)
        stated = stated_of(stated_model)
        given = None if survey is None else read_survey(survey)
        audited, unused = survey_of_model(stated_model, stated, fixed=names_in(fix), given=given)
    left = [f"{count} {kind.words}" for kind, count in losses(content, ALL.difference(NOT_USED))]
    notes = (*content.notes, *added, *([f"not used of the model: {listed(left)}"] if left else []), *unused)
    folder = out or Path("out") / f"{folder_name(stated_model.name)}_audit"
    refuse_foreign_folder(folder)
    origin = Origin(model, model.parent)
    if not overwrite:
        refuse_other_origin(folder, origin, survey=audited.name, photographs=False)
    compile_first()
    with (
        working_on(str(model)),
        drawn_progress() as drawn,
        one_blas_thread(),
        lock_folder(folder),
        SurveyLog(watch=drawn) as log,
    ):
        history, work = RunHistory.of_user(), work_of(audited, NO_PHOTOGRAPHS)
        expected = forecast(work, history.read(), without=("comparison",))
        expected.refuse(remedy="end other programs, or use a larger computer")
        if sentence := expected.announced():
            print(sentence, file=sys.stderr)
        drawn.countdown.expected = expected.seconds
        log.start(audited.name, model, **origin.written(folder))
        with reporting_unfinished(folder, log, pdf=pdf):
            result = run_survey(audited, jobs=cores(), progress=log)
        findings = findings_of(result)
        judged = audit_of(stated_model, stated, findings.result, notes=notes)
        page = page_of(judged, report="report.html")

        def finish(part: Path) -> None:
            for name, text in texts_of(page).items():
                (part / name).write_text(text, encoding="utf-8", newline="")
            log.close_into(part, findings)

        write_result(findings, folder, finish=finish, progress=log)
        history.add(Run(work, drawn.finished(), peak_bytes() / 1e6))
    print_verdict(page.verdict)
    for note in (*notes, *judged.like):
        print(f"{model}: {note}")
    print(replace(page, sections=page.sections[:SHOWN]).text)
    print_page("Report", folder / "report.html", pdf=pdf)
    print_page("Audit", folder / page.path, pdf=pdf)
    exit_by(page.verdict)
