"""The folder of a result: written beside its place, then put there by one rename, or not at all.

Survey file and photographs of the result in a folder, which no other survey replaces unseen.
"""

from __future__ import annotations

import os
import re
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from sfm.adjustment.result import Adjustment
from sfm.conventions import BoolArray, FloatArray
from sfm.display import counted, listed
from sfm.errors import OutputError, SurveyFileError
from sfm.files.covariance_file import ARRAYS, POINTS_NAME, write_covariance
from sfm.files.covariance_file import NAME as POINT_COVARIANCE
from sfm.files.csv_tables import read_table
from sfm.files.manifest import MANIFEST, refuse_foreign_folder
from sfm.files.plain_text import Content, Name, read_json
from sfm.files.result_tables import MOMENTS, MOUNTS, TABLES
from sfm.files.whole_files import whole_folder
from sfm.kernels.threads import give_back_memory
from sfm.remarks.remark import remark
from sfm.report.figures.overlays import draw_overlays
from sfm.report.figures.plot_process import (
    EpipolarMap,
    PlotCamera,
    PlotData,
    PlotProcess,
    ProjectionMap,
    draw_plots,
)
from sfm.report.findings.calibrated_cameras import projection_of
from sfm.report.findings.findings import Findings, with_remark
from sfm.report.findings.precision import adjusted_sigmas, root_mean_square
from sfm.report.log import LOG, read_log
from sfm.report.numbers import finer_unit
from sfm.report.pages import html_of
from sfm.report.survey_report import text_report
from sfm.report.tables.csv_files import write_tables
from sfm.report.tables.summary import write_summary
from sfm.report.viewer.embedded import viewer_of
from sfm.report.viewer.pictures import BUDGET_MB, cut_pictures
from sfm.report.viewer.solution_scene import scene_of_result
from sfm.result import StageTime
from sfm.runtime.progress import SILENT, Progress

MAX_FOLDER_BYTES = 100  # of the name of a survey's folder; disks take 255, endings included
WRITTEN = (
    *(
        "summary.json",
        *(table.file for table in TABLES),
        MOUNTS,
        MOMENTS,
        POINT_COVARIANCE,
        POINTS_NAME,
        ARRAYS,
    ),
    *("report.txt", "report.html", "points.ply", "colmap", "overlays", "pictures", "plots", "log.jsonl"),
    MANIFEST,
)


def write_result(
    findings: Findings,
    out: Path,
    *,
    write_colmap: Callable[[Path], None] | None = None,
    finish: Callable[[Path], None] | None = None,
    jobs: int = 1,
    budget_mb: float = BUDGET_MB,
    progress: Progress = SILENT,
    plot_process: PlotProcess | None = None,
) -> Path:
    """Write everything that a survey gives into one folder, whole or not at all.

    Args:
        findings: the result and the remarks on it.
        out: the folder; an unchanged earlier result in it is replaced, anything else in it is an error.
        write_colmap: fills the folder `colmap`, which it is given; None leaves it out.
        finish: is given the folder when all else is in it, and may add log.jsonl.
        jobs: photographs drawn at the same time.
        budget_mb: what the pictures inside report.html may take, 10^6 bytes.
        progress: called for every photograph.
        plot_process: draws the plots meanwhile; without it they are drawn here.

    Returns:
        The path of report.html.

    Raises:
        OutputError: the folder cannot be written, or contains something else than an earlier result.
    """
    out = Path(out)
    refuse_foreign_folder(out)
    started = time.perf_counter()
    result = findings.result
    progress.stage("report", 2 * len(result.photographs))
    with whole_folder(out, "the result", replaceable=True) as folder:
        if write_colmap is not None:
            (folder / "colmap").mkdir()
            write_colmap(folder / "colmap")
        shown = plot_data(findings)
        if plot_process is not None:
            plot_process.begin(shown)
        scene = scene_of_result(findings)
        give_back_memory()
        # one after another: beside Python at work threads of short calls wait for each turn
        overlays = draw_overlays(result, jobs=jobs, progress=progress)
        files = {one.image: one.path for one in result.photographs}
        pictures = cut_pictures(
            scene, files, budget_mb=budget_mb, beside="pictures", jobs=jobs, progress=progress
        )
        drawn = {overlay.image for overlay in overlays}
        lost = [one.image for one in result.photographs if one.image not in drawn]
        if lost:
            findings = with_remark(findings, remark("photographs_not_drawn", photographs=lost))
            result = findings.result
        write_tables(findings, folder)
        if overlays:
            (folder / "overlays").mkdir()
        for overlay in overlays:
            (folder / "overlays" / overlay.file_name).write_bytes(overlay.jpeg)
        if pictures.beside:
            (folder / "pictures").mkdir()
        for name, content in pictures.beside.items():
            (folder / "pictures" / name).write_bytes(content)
        plots = draw_plots(shown) if plot_process is None else plot_process.plots()
        (folder / "plots").mkdir()
        for plot in plots:
            (folder / "plots" / f"{plot.stem}.png").write_bytes(plot.png)
        report_time = StageTime("report", time.perf_counter() - started)
        timed = replace(findings, result=replace(result, seconds=(*result.seconds, report_time)))
        write_summary(timed, folder)
        joint = result.solution.with_joint_covariance
        if joint.covariance is not None:
            write_covariance(folder, joint.covariance, joint.network.points, joint.covariance_points)
        (folder / "report.txt").write_text(text_report(timed), encoding="utf-8")
        beside = {"plots": plots, "overlays": overlays, "has_model": write_colmap is not None}
        page = html_of(timed, viewer=viewer_of(scene, pictures), **beside)
        (folder / "report.html").write_text(page, encoding="utf-8")
        if finish is not None:
            finish(folder)
    return out / "report.html"


def folder_name(name: str) -> str:
    """Return the name of the folder of a survey's result: that of the survey, as far as all disks take it."""
    kept = re.sub(r"[^\w.\-]+", "_", name).encode()[:MAX_FOLDER_BYTES].decode(errors="ignore")
    return kept.strip("._-") or "survey"


def plot_data(findings: Findings) -> PlotData:
    """Return what the plots of a report show."""
    adjustment, interior, geometry = findings.result.adjustment, findings.interior, findings.geometry
    network, estimate, used = adjustment.network, adjustment.estimate, ~adjustment.rejected
    seen = network.image_points.select(used)
    sigma = np.array([root_mean_square(one) for one in adjusted_sigmas(adjustment.covariance.points)])
    factor, unit = finer_unit(findings.result.length_unit, float(findings.precision.largest[3]))
    centre = np.array([camera.frame[:2] for camera in estimate.cameras])
    sizes = {camera.name: camera.size_px for camera in estimate.cameras}
    return PlotData(
        unit=findings.result.length_unit,
        images=network.images,
        position=estimate.position,
        rotation=estimate.rotation,
        points=estimate.points,
        cameras=tuple(PlotCamera(one.name, one.camera.c_px, one.camera.size_px) for one in interior.families),
        camera=interior.family,
        image=seen.image,
        xy=seen.xy,
        from_centre=seen.xy - centre[network.camera[seen.image]],
        residuals=adjustment.residuals[used],
        standardised=_standardised_residuals(adjustment),
        image_rms_px=geometry.image_rms_px,
        image_points=geometry.image_points,
        rms_px=adjustment.rms_px,
        sigma=sigma * factor,
        sigma_unit=unit,
        projection=tuple(
            _projection(adjustment, interior.family == f) for f in range(len(interior.families))
        ),
        epipolar=tuple(
            EpipolarMap(
                f"{mount.camera} from {rig.reference}",
                sizes[mount.camera],
                mount.epipolar.xy,
                mount.epipolar.px,
                mount.epipolar.rms_px,
            )
            for rig in findings.rigs
            for mount in rig.mounts
            if mount.epipolar is not None and len(mount.epipolar.px)
        ),
    )


def _projection(adjustment: Adjustment, photographs: BoolArray) -> ProjectionMap | None:
    """Return the projection uncertainty of the camera of photographs, (m,); None where it was held."""
    found = projection_of(adjustment, photographs)
    return None if found is None else ProjectionMap(*found)


def _standardised_residuals(adjustment: Adjustment) -> FloatArray:
    """Return accepted residuals over their standard deviations a posteriori, shape (2k,).

    Source: Baarda (1968): sigma of v = sigma0 * sigma * sqrt(r) with the redundancy number r.
    """
    used = ~adjustment.rejected
    variance = np.einsum("kii->ki", adjustment.image_covariance[used])
    r = adjustment.redundancy_numbers[used]
    sigma = adjustment.sigma0 * np.sqrt(np.where(r > 1e-6, variance * r, np.nan))
    return np.asarray((adjustment.residuals[used] / sigma).ravel())


@dataclass(frozen=True)
class Origin:
    """Origin of a result: the files that it was computed from."""

    file: Path  # the survey file
    images: Path  # folder of the photographs

    def written(self, out: Path) -> dict[str, str]:
        """Return the paths from the folder of the result, which stay true where all are moved together."""
        return {"survey_at": path_from(out, self.file), "images_at": path_from(out, self.images)}


def read_origin(out: Path) -> Origin | None:
    """Return of what the result in a folder is; None without a result that states it."""
    try:
        lines = read_log(out / LOG)
    except OSError:
        return None
    begun = next((line for line in lines if line.get("event") == "start"), {})
    file, images = begun.get("survey_at"), begun.get("images_at")
    if not isinstance(file, str) or not isinstance(images, str):
        return None
    return Origin(out / file, out / images)


class _Summary(Content):
    """The part of summary.json that is read."""

    survey: Name


def refuse_other_origin(out: Path, origin: Origin, *, survey: str = "", photographs: bool = True) -> None:
    """Raise OutputError where a folder has the result of another survey file or of other photographs.

    A result that does not state its origin, as one that a script wrote, is another's if it has another name,
    or none of the photographs.

    Args:
        out: the folder.
        origin: of what is to be written there.
        survey: its name, where it is known.
        photographs: whether it is of photographs.
    """
    earlier = read_origin(out)
    if earlier is None:
        try:
            name = read_json(out / "summary.json", _Summary, "the summary of a result").survey
        except SurveyFileError:
            return  # no result
        try:
            images = read_table(out / "images.csv", ("image",), (), ignored=None).texts[0]
        except SurveyFileError:
            images = ()
        other_name = bool(survey) and name != survey
        present = any((origin.images / one).is_file() for one in images)
        if other_name or (photographs and not present):
            of = f"{counted(len(images), 'photograph')} ({listed(images)})"
            what = of if images else "no table of photographs"
            raise OutputError(
                f"{out}: has the result of survey {name} with {what}, which --overwrite replaces; "
                "--out names another folder"
            )
        return
    for what, there, here in (
        ("the survey", earlier.file, origin.file),
        ("the photographs in", earlier.images, origin.images),
    ):
        if os.path.realpath(there) != os.path.realpath(here):
            raise OutputError(
                f"{out}: has the result of {what} {os.path.normpath(there)}, which --overwrite replaces; "
                "--out names another folder"
            )


def path_from(folder: Path, path: Path) -> str:
    """Return a path from a folder, which stays true where both are moved together."""
    folder, path = Path(os.path.realpath(folder)), Path(os.path.realpath(path))
    try:
        return os.path.relpath(path, folder)
    except ValueError:  # on another drive
        return str(path)
