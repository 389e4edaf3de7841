"""The command `adjust`: from measured image points to the report."""

from __future__ import annotations

from sfm.cli.options import (
    AllowOutside,
    Calibration,
    Cluster,
    Out,
    Overwrite,
    Pdf,
    SurveyFile,
    Verbose,
    Weighted,
)
from sfm.cli.survey_runs import RunOptions, run_survey_file


def adjust(
    survey_file: SurveyFile,
    camera: Calibration = None,
    camera_weighted: Weighted = False,
    out: Out = None,
    overwrite: Overwrite = False,
    cluster: Cluster = None,
    allow_outside: AllowOutside = False,
    verbose: Verbose = False,
    pdf: Pdf = False,
) -> None:
    """Run a survey from measured image points to the report.

    [observations] in the survey file states the image points, which replace photographs.

    Exit code 0 with a dependable result, with or without remarks; 1 if the result is not dependable, for the
    reasons in the report, or a stage cannot go on; 2 if the input must be corrected.
    """
    options = RunOptions(
        out=out,
        allow_outside=allow_outside,
        verbose=verbose,
        pdf=pdf,
        from_photographs=False,
        camera=camera,
        weighted=camera_weighted,
        overwrite=overwrite,
        cluster=cluster,
    )
    run_survey_file(survey_file, options)
