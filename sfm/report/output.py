"""The folder of a result, with the origin and the log of the survey.

The folder is written under a temporary name and then renamed. Its log is for programs: one JSON object per
line, written as events happen. Every line has `time` (UTC) and `event`:

    start       survey, file, version; survey_at, images_at (paths relative to the folder of the result);
                in a batch: inputs (fingerprint of all input files)
    photograph  image, targets, rejected, features, stored (measured in an earlier run), seconds; or failed
    stage       stage, seconds, steps
    warning     text
    remark      kind, severity, text, subjects, numbers, cause, remedy
    result      verdict, sigma0_px, rms_px, photographs, points, observations, stored_photographs, ...;
                with reason and stage if that stage of the survey could not go on
    failed      reason
"""

from __future__ import annotations

import json
import os
import re
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import numpy as np

from sfm.files.covariance_file import write_covariance
from sfm.files.csv_tables import read_table
from sfm.files.open_folders import disk_errors, make_folder, open_regular_file, refuse_foreign_folder
from sfm.files.plain_text import Content, Name, or_none, read_json
from sfm.files.whole_files import whole_folder
from sfm.judgement.calibrated_cameras import projection_of
from sfm.judgement.checks import root_mean_squares_of_rows
from sfm.judgement.survey_result import StageTime, SurveyResult
from sfm.model.conventions import AnyArray
from sfm.model.display import counted, listed
from sfm.model.errors import OutputError, SurveyFileError
from sfm.model.remarks.remark import remark
from sfm.report.figures.overlays import Overlay, draw_overlays
from sfm.report.figures.plot_data import EpipolarMap, PlotCamera, PlotData, ProjectionMap
from sfm.report.figures.plot_process import PlotProcess, draw_plots
from sfm.report.figures.point_colours import photographed_colours
from sfm.report.findings import Findings, with_remark
from sfm.report.pages import html_of, page_of, text, texts_of
from sfm.report.phrases import finer_unit
from sfm.report.precision import adjusted_sigmas
from sfm.report.survey_report import text_report
from sfm.report.tables.csv_files import write_tables
from sfm.report.tables.summary import write_summary
from sfm.report.unfinished import verdict
from sfm.report.viewer.embedded import scene_of_result, viewer_of
from sfm.report.viewer.pictures import BUDGET_MB, cut_pictures
from sfm.runtime.progress import SILENT, Progress, give_back_memory
from sfm.survey.unfinished import UnfinishedSurvey

LOG = "log.jsonl"  # in the folder of a result
MAX_LOG_BYTES = 50_000_000  # of a log to be read back
MAX_FOLDER_BYTES = 100  # of the name of a survey's folder; file systems allow 255, with suffixes


def write_result(
    findings: Findings,
    out: Path,
    *,
    write_colmap: Callable[[Path, AnyArray | None], None] | None = None,
    finish: Callable[[Path], None] | None = None,
    jobs: int = 1,
    budget_mb: float = BUDGET_MB,
    progress: Progress = SILENT,
    plot_process: PlotProcess | None = None,
) -> Path:
    """Write all results of a survey into one folder, whole or not at all.

    Args:
        findings: the result and the remarks on it.
        out: the folder; an unchanged earlier result in it is replaced, anything else in it is an error.
        write_colmap: fills the folder `colmap`, whose path it receives, with the colours of the points,
            uint8, (n, 3), None if unknown; None omits that folder.
        finish: receives the folder when everything else is written, and may add log.jsonl.
        jobs: photographs drawn at the same time.
        budget_mb: maximum size of the pictures inside report.html, 10^6 bytes.
        progress: called for every photograph.
        plot_process: draws the plots in parallel; without it they are drawn here.

    Returns:
        The path of report.html.

    Raises:
        OutputError: the folder cannot be written, or contains something other than an earlier result.
    """
    out, started, result = Path(out), time.perf_counter(), findings.result
    with _result_folder(out, finish, progress, steps=2 * len(result.photographs)) as folder:
        shown = plot_data(findings)
        if plot_process is not None:
            plot_process.begin(shown)
        colours = photographed_colours(result.photographs, result.adjustment, jobs=jobs)
        if write_colmap is not None:
            (folder / "colmap").mkdir()
            write_colmap(folder / "colmap", colours)
        scene = scene_of_result(findings, colours)
        give_back_memory()
        # One after another: while Python works, threads with short calls wait for their turn each time.
        overlays = draw_overlays(result.photographs, result.adjustment, jobs=jobs, progress=progress)
        files = {photograph.image: photograph.path for photograph in result.photographs}
        pictures = cut_pictures(
            scene, files, budget_mb=budget_mb, beside="pictures", jobs=jobs, progress=progress
        )
        drawn = {overlay.image for overlay in overlays}
        lost = [photograph.image for photograph in result.photographs if photograph.image not in drawn]
        if lost:
            findings = with_remark(findings, remark("photographs_not_drawn", photographs=lost))
            result = findings.result
        write_tables(findings, folder, colours)
        _write_overlays(overlays, folder)
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
    return out / "report.html"


def write_unfinished(
    reached: UnfinishedSurvey,
    out: Path,
    *,
    finish: Callable[[Path], None] | None = None,
    jobs: int = 1,
    progress: Progress = SILENT,
) -> Path:
    """Write the report of a survey that a stage could not finish, as `write_result` writes a result.

    Args:
        reached: how far the survey came.
        out: as in `write_result`, and so are the others.
        finish: receives the folder, and may add log.jsonl.
        jobs: photographs drawn at the same time.
        progress: called for every photograph.

    Returns:
        The path of report.html.

    Raises:
        OutputError: as in `write_result`.
    """
    out = Path(out)
    with _result_folder(out, finish, progress, steps=len(reached.photographs)) as folder:
        overlays = draw_overlays(reached.photographs, reached.network, jobs=jobs, progress=progress)
        _write_overlays(overlays, folder)
        page = page_of(reached, overlays=overlays)
        for name, content in texts_of(page).items():
            (folder / name).write_text(content, encoding="utf-8", newline="")
        (folder / "report.txt").write_text(text(page), encoding="utf-8")
    return out / "report.html"


@contextmanager
def _result_folder(
    out: Path, finish: Callable[[Path], None] | None, progress: Progress, *, steps: int
) -> Iterator[Path]:
    """Yield the folder to write, which appears as `out` when all is written and `finish` has received it."""
    refuse_foreign_folder(out)
    progress.stage("report", steps)
    with whole_folder(out, "the result", replaceable=True) as folder:
        yield folder
        if finish is not None:
            finish(folder)


def _write_overlays(overlays: Sequence[Overlay], folder: Path) -> None:
    """Write overlays into a folder of that name; none if there are none."""
    if overlays:
        (folder / "overlays").mkdir()
    for overlay in overlays:
        (folder / "overlays" / overlay.file_name).write_bytes(overlay.jpeg)


def folder_name(name: str) -> str:
    """Return the folder name for a survey's result: its name, as far as every file system accepts it."""
    kept = re.sub(r"[^\w.\-]+", "_", name).encode()[:MAX_FOLDER_BYTES].decode(errors="ignore")
    return kept.strip("._-") or "survey"


def plot_data(findings: Findings) -> PlotData:
    """Return the data of the plots of a report."""
    adjustment, interior, geometry = findings.result.adjustment, findings.interior, findings.geometry
    network, estimate, used = adjustment.network, adjustment.estimate, ~adjustment.rejected
    seen = network.image_points.select(used)
    sigma = root_mean_squares_of_rows(adjusted_sigmas(adjustment.covariance.points))
    factor, unit = finer_unit(findings.result.length_unit, float(findings.precision.largest[3]))
    # Baarda (1968): sigma of v = sigma0 * sigma * sqrt(r) with the redundancy number r
    variance = np.einsum("kii->ki", adjustment.image_covariance[used])
    r = adjustment.redundancy_numbers[used]
    sigma_v = adjustment.sigma0 * np.sqrt(np.where(r > 1e-6, variance * r, np.nan))
    centre = np.array([camera.frame[:2] for camera in estimate.cameras])
    sizes = {camera.name: camera.size_px for camera in estimate.cameras}
    return PlotData(
        unit=findings.result.length_unit,
        images=network.images,
        position=estimate.position,
        rotation=estimate.rotation,
        points=estimate.points,
        cameras=tuple(
            PlotCamera(family.name, family.camera.c_px, family.camera.size_px) for family in interior.families
        ),
        camera=interior.family,
        image=seen.image,
        xy=seen.xy,
        from_centre=seen.xy - centre[network.camera[seen.image]],
        residuals=adjustment.residuals[used],
        standardised=(adjustment.residuals[used] / sigma_v).ravel(),
        image_rms_px=geometry.image_rms_px,
        image_points=geometry.image_points,
        rms_px=adjustment.rms_px,
        sigma=sigma * factor,
        sigma_unit=unit,
        projection=tuple(
            None if projection is None else ProjectionMap(*projection)
            for f in range(len(interior.families))
            for projection in [projection_of(adjustment, interior.family == f)]
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


@dataclass(frozen=True)
class Origin:
    """Origin of a result: the files from which it was computed."""

    file: Path  # the survey file
    images: Path  # folder of the photographs

    def written(self, out: Path) -> dict[str, str]:
        """Return the paths relative to the folder of the result, which stay valid if all move together."""
        return {"survey_at": path_from(out, self.file), "images_at": path_from(out, self.images)}


def read_origin(out: Path) -> Origin | None:
    """Return the origin of the result in a folder; None without a result that states it."""
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
    """Raise OutputError if a folder contains the result of another survey file or of other photographs.

    A result may not state its origin, for example if a script wrote it. It then counts as foreign if it has
    another name, or if none of its photographs is present.

    Args:
        out: the folder.
        origin: origin of the new result.
        survey: name of the new survey, if known.
        photographs: whether the new survey has photographs.
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
        present = any((origin.images / image).is_file() for image in images)
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
    """Return a path relative to a folder, which stays valid if both are moved together."""
    folder, path = Path(os.path.realpath(folder)), Path(os.path.realpath(path))
    try:
        return os.path.relpath(path, folder)
    except ValueError:  # on another drive
        return str(path)


class SurveyLog:
    """Progress written to a log; with a path every line goes to the file at once.

    Several threads count steps, hence the lock.
    """

    def __init__(self, path: Path | None = None, *, append: bool = False, watch: Progress = SILENT) -> None:
        """Begin a log.

        Args:
            path: file of the log, if any; an earlier log there is replaced or appended to.
            append: whether to append to an earlier log.
            watch: receives the same progress.

        Raises:
            OutputError: the file cannot be written, or is not a log.
        """
        self._lines: list[str] = []
        self._lock = threading.Lock()
        self._path = path
        self._watch = watch
        self._file = None
        self._stage: str | None = None
        self._begun = 0.0
        self._steps = 0
        if path is not None:
            with disk_errors(f"{path}: the log cannot be written"):
                make_folder(path.parent)
                if append:
                    refuse_other_log(path)
                else:
                    remove_log(path)  # another run may still have it open
                flags = os.O_WRONLY | os.O_CREAT | (os.O_APPEND if append else os.O_EXCL)
                self._file = os.fdopen(open_regular_file(path, flags), "a", encoding="utf-8")

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._file is not None:
            with suppress(OSError):  # reported when the line was written
                self._file.close()

    def start(self, survey: str, file: Path, **more: Any) -> None:
        """Write the first line of a survey.

        Raises:
            OutputError: the file cannot be written.
        """
        self.note("start", survey=survey, file=str(file), version=version("kolinear"), **more)

    def note(self, event: str, **what: Any) -> None:
        """Write one line.

        Raises:
            OutputError: the file cannot be written.
        """
        now = datetime.now(UTC).isoformat(timespec="milliseconds")
        line = json.dumps({"time": now, "event": event, **what}, ensure_ascii=False)
        with self._lock:
            self._lines.append(line)
            if self._file is None:
                return
            with disk_errors(f"{self._path}: the log cannot be written"):
                self._file.write(line + "\n")
                self._file.flush()

    def stage(self, name: str, total: int | None = None) -> None:
        """Log the stage that ends when this one begins; a second call for a stage gives its total."""
        self._watch.stage(name, total)
        if name == self._stage:
            return
        self.end_stage()
        self._stage, self._begun, self._steps = name, time.perf_counter(), 0

    def advance(self, step: str = "") -> None:
        """Count one step of the stage."""
        self._watch.advance(step)
        with self._lock:
            self._steps += 1

    def step(self, name: str, done: int | None = None, total: int | None = None) -> None:
        """Pass on a step within the stage; the log contains only stages."""
        self._watch.step(name, done, total)

    def end_stage(self) -> None:
        """Log the current stage, if there is one."""
        if self._stage is not None:
            seconds = round(time.perf_counter() - self._begun, 4)
            steps = {"steps": self._steps} if self._steps else {}
            self.note("stage", stage=self._stage, seconds=seconds, **steps)
            self._stage = None

    def close_into(self, folder: Path, ended: Findings | UnfinishedSurvey, **more: Any) -> None:
        """Log the end of a survey, and write all lines into the folder of the result.

        Args:
            folder: the folder, before it is renamed.
            ended: findings of the survey, or how far it came.
            more: further entries of the last line.
        """
        self.end_stage()
        judged = ended.verdict if isinstance(ended, Findings) else verdict(ended)
        for said in judged.remarks:
            self.note("remark", **said.as_dict())
        self.note("result", **result_entries(ended), **more)
        (folder / LOG).write_text("\n".join(self._lines) + "\n", encoding="utf-8")


def result_entries(ended: Findings | UnfinishedSurvey) -> dict[str, Any]:
    """Return the key figures of a result for a log or a table of surveys; None if unknown."""
    if isinstance(ended, UnfinishedSurvey):
        return {
            "survey": ended.survey,
            "verdict": verdict(ended).level,
            "reason": ended.reason,
            "stage": ended.stage,
            "sigma0_px": None,
            "rms_px": None,
            "photographs": 0 if ended.oriented is None else int(ended.oriented.sum()),
            "photographs_total": ended.images_total,
            "points": None,
            "comparison": "none",
            **_photographs(ended),
        }
    findings, result = ended, ended.result
    a, comparison = result.adjustment, result.comparison
    return {
        "survey": result.survey,
        "verdict": findings.verdict.level,
        "sigma0_px": or_none(a.sigma0_px),
        "rms_px": or_none(a.rms_px),
        "photographs": len(a.network.images),
        "photographs_total": result.images_total,
        "points": len(a.network.points),
        "observations": int((~a.rejected).sum()),
        "rejected": int(a.rejected.sum()),
        "iterations": a.iterations,
        "converged": a.converged,
        "comparison": "none" if comparison is None else comparison.outcome,
        **_photographs(result),
    }


def _photographs(survey: SurveyResult | UnfinishedSurvey) -> dict[str, Any]:
    """Return the photographs measured in an earlier run, and those that failed."""
    return {
        "stored_photographs": [p.image for p in survey.photographs if p.stored],
        "failed_photographs": [{"image": f.image, "reason": f.reason.as_dict()} for f in survey.failed],
    }


def refuse_other_log(path: Path) -> None:
    """Raise OutputError if a file is not a log, or if the path leads through a link."""
    try:
        os.close(open_regular_file(path, os.O_RDONLY))
        if path.stat().st_size and not any({"time", "event"} <= entry.keys() for entry in read_log(path)):
            raise OutputError(f"{path}: is no log of Kolinear, and is left alone; needed another --out")
    except FileNotFoundError:
        return
    except OSError as error:
        raise OutputError(f"{path}: the log cannot be written: {error.strerror}") from error


def remove_log(path: Path) -> None:
    """Remove a log, if it exists.

    Raises:
        OutputError: the file is not a log, or cannot be removed.
    """
    refuse_other_log(path)
    with disk_errors(f"{path}: the log cannot be removed"):
        path.unlink(missing_ok=True)


def read_log(path: Path) -> tuple[dict[str, Any], ...]:
    """Return the lines of a log, without incomplete lines such as a killed run leaves.

    Raises:
        OSError: the file cannot be read.
    """
    if path.stat().st_size > MAX_LOG_BYTES:
        return ()
    entries = []
    for line in path.read_text(encoding="utf-8", errors="replace").splitlines():
        try:
            entry = json.loads(line)
        except (ValueError, RecursionError):
            continue
        if isinstance(entry, dict):
            entries.append(entry)
    return tuple(entries)
