"""Runs of one survey and drafts of its file: what run, adjust, init and epochs share."""

from __future__ import annotations

import os
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext, suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple, Protocol

from sfm.cli.process import FAILED, compile_first, loading
from sfm.model.errors import KolinearError, OutputError
from sfm.runtime.faults import working_on

if TYPE_CHECKING:
    from sfm.judgement.survey_result import SurveyResult
    from sfm.model.remarks.remark import Remark
    from sfm.products.drafting.draft import Draft
    from sfm.report.output import SurveyLog

RINGS_PICTURE = "-rings.png"  # after the name of a drafted survey file
REMEDY_OF_POINTS = "end other programs, use a larger computer, or adjust in blocks on a cluster (--cluster)"
SURVEY_FILE = "survey.toml"  # name in a folder of photographs


def run_file(survey_file: Path) -> Path:
    """Run a survey file, with photographs or without, and return its result folder, out/NAME.

    Args:
        survey_file: the survey file.
    """
    return run_survey_file(survey_file, RunOptions(pictures_mb=15.0))


class SurveyProduct(Protocol):
    """What a command makes of a survey, beside its report."""

    def revise(self, survey_file: Path, result: SurveyResult) -> bool:
        """Return whether the survey file was changed because of a result, so that it is run once more."""

    def write(self, result: SurveyResult, part: Path, folder: Path) -> None:
        """Write further files into the folder of the result, which is complete later and named otherwise."""

    def show(self, folder: Path, *, pdf: bool = False) -> bool:
        """Print the product in place of the summary; return whether the result is dependable."""


@dataclass(frozen=True)
class RunOptions:
    """How a survey is run, and where its result is written."""

    images: Path | None = None  # folder of the photographs; None: the one that the survey file states
    out: Path | None = None  # folder of the result; None: out/NAME
    jobs: int | None = None  # photographs at a time; None: one per core
    cluster: str | None = None  # Dask scheduler whose workers adjust in blocks; None: this process adjusts
    allow_outside: bool = False  # whether the survey file may name files outside its folder
    verbose: bool = False  # whether more is printed
    from_photographs: bool | None = None  # False for surveys with [observations]; None: the file decides
    camera: Path | None = None  # result with the interior orientation to use; None: that of the survey file
    weighted: bool = False  # whether that orientation is observed, not fixed
    overwrite: bool = False  # whether a result of other photographs is replaced
    pictures_mb: float = 0.0  # largest size of the pictures in the report, 10^6 bytes
    pdf: bool = False  # whether the pages are written as PDF too
    product: SurveyProduct | None = None  # what is made of the survey, beside its report


def run_survey_file(survey_file: Path, options: RunOptions) -> Path:
    """Run a survey, write and print its result, and return the result folder."""
    begun = time.perf_counter()
    with loading():
        from sfm.cli.console import print_result
        from sfm.files.globs import nearest_name
        from sfm.files.open_folders import refuse_foreign_folder
        from sfm.library.blocks import blocks_on_dask
        from sfm.library.results import read_result
        from sfm.library.surveys import colmap_writer, programs_of
        from sfm.pipeline import run_survey
        from sfm.report.figures.plot_process import plot_process
        from sfm.report.findings import findings_of
        from sfm.report.output import (
            Origin,
            SurveyLog,
            folder_name,
            refuse_other_origin,
            write_result,
        )
        from sfm.runtime.forecast import OTHER_REMEDY, Run, RunHistory, forecast
        from sfm.runtime.memory import peak_bytes
        from sfm.runtime.progress_bar import drawn_progress
        from sfm.runtime.threads import cores, one_blas_thread
        from sfm.survey.inputs.calibration import Calibration, read_calibrations
        from sfm.survey.inputs.measurements import NO_PHOTOGRAPHS, find_photographs, work_of
        from sfm.survey.inputs.named_folders import named_folder
        from sfm.survey.inputs.photograph_names import name_photographs
        from sfm.survey.inputs.sources import declared, reads_photographs
        from sfm.survey.inputs.survey import survey_of_file, with_calibration
        from sfm.survey.inputs.survey_file import read_survey_file
        from sfm.survey.measuring.measured_store import MeasuredStore

    if not survey_file.exists():
        raise KolinearError(f"{survey_file}: neither a survey file nor a folder{nearest_name(survey_file)}")
    with working_on(str(survey_file)):
        described = read_survey_file(survey_file, allow_outside=options.allow_outside)
    from_photographs = options.from_photographs
    if from_photographs is None:
        from_photographs = reads_photographs(described)
    if from_photographs and not reads_photographs(described):
        raise KolinearError(
            f"{survey_file}: has {' and '.join(row.section for row in declared(described))} instead of "
            f"photographs; run kolinear adjust {survey_file}, "
            "or write [[observations]] for image points beside targets or texture"
        )
    if not from_photographs and reads_photographs(described):
        raise KolinearError(
            f"{survey_file}: has no [observations] alone; with photographs, run kolinear run {survey_file}"
        )
    with working_on(str(survey_file)):
        survey = survey_of_file(described)
    if options.camera is not None:
        with working_on(str(options.camera)):
            if (options.camera / "cameras.csv").is_file():
                calibrations = read_calibrations(options.camera)
            else:
                cameras = read_result(options.camera).estimate.cameras
                calibrations = tuple(Calibration.of_camera(calibrated) for calibrated in cameras)
            survey = with_calibration(survey, calibrations, str(options.camera), weighted=options.weighted)
    elif options.weighted:
        raise KolinearError("--camera-weighted: expected --camera RESULT")
    others = programs_of(survey.compare.backend, survey.compare.baseline)
    folder = options.out or Path("out") / folder_name(survey.name)
    refuse_foreign_folder(folder)  # before any work is done
    images = named_folder(described, options.images)
    origin = Origin(survey_file, images or survey_file.parent / (described.photographs or ""))
    if not options.overwrite:
        refuse_other_origin(folder, origin, survey=survey.name, photographs=from_photographs)
    files = NO_PHOTOGRAPHS
    if from_photographs:
        files = find_photographs(survey, images_dir=images)
        name_photographs(survey, files)  # wrong folders and names are reported before anything is compiled
    compile_first()
    jobs = options.jobs or cores()
    workers, store = 1, None
    if from_photographs:
        workers, store = jobs, MeasuredStore.of_user()
        store.remove_old()
    with (
        working_on(str(survey_file)),
        drawn_progress() as drawn,
        one_blas_thread(),
        plot_process(jobs) as plots,
        lock_folder(folder),
        blocks_on_dask(None, options.cluster, None, option="--cluster") if options.cluster else nullcontext(),
        SurveyLog(watch=drawn) as log,
    ):
        history, work = RunHistory.of_user(), work_of(survey, files)
        expected = forecast(work, history.read())
        if options.cluster is None:
            expected.refuse(remedy=OTHER_REMEDY if from_photographs else REMEDY_OF_POINTS)
        if sentence := expected.announced():
            print(sentence, file=sys.stderr)
        drawn.countdown.expected = expected.seconds
        log.start(survey.name, survey_file, **origin.written(folder))
        with reporting_unfinished(folder, log, jobs=workers, pdf=options.pdf):
            result = run_survey(
                survey, images_dir=images, jobs=workers, others=others, store=store, progress=log
            )
            revised = options.product is not None and options.product.revise(survey_file, result)
            if revised:
                drawn.countdown.taken.clear()  # all stages but the measurement come again
                survey = survey_of_file(read_survey_file(survey_file, allow_outside=options.allow_outside))
                result = run_survey(
                    survey, images_dir=images, jobs=workers, others=others, store=store, progress=log
                )
        findings = findings_of(result)

        def finish(part: Path) -> None:
            if options.product is not None:
                options.product.write(findings.result, part, folder)
            log.close_into(part, findings)

        page = write_result(
            findings,
            folder,
            write_colmap=colmap_writer(result),
            finish=finish,
            jobs=workers,
            budget_mb=options.pictures_mb,
            progress=log,
            plot_process=plots,
        )
        alone = options.cluster is None  # else other computers measured, matched or adjusted
        if alone and not revised and (store is None or not store.has_earlier):
            history.add(Run(work, drawn.finished(), peak_bytes() / 1e6))
    seconds = time.perf_counter() - begun
    if options.product is not None:
        dependable = options.product.show(folder, pdf=options.pdf)
    else:
        dependable = print_result(findings, page, seconds=seconds, verbose=options.verbose, pdf=options.pdf)
    if not dependable:
        raise SystemExit(FAILED)
    return folder


@contextmanager
def reporting_unfinished(folder: Path, log: SurveyLog, *, jobs: int = 1, pdf: bool = False) -> Iterator[None]:
    """Write and print how far a survey came that a stage could not finish.

    Args:
        folder: of the result.
        log: of the survey; it ends in the folder.
        jobs: photographs drawn at the same time.
        pdf: whether to write the report as PDF too.

    Raises:
        SystemExit: the survey was not finished.
    """
    from sfm.cli.console import print_unfinished
    from sfm.report.output import write_unfinished
    from sfm.survey.unfinished import UnfinishedSurveyError

    try:
        yield
    except UnfinishedSurveyError as error:
        reached = error.reached
        page = write_unfinished(
            reached, folder, finish=lambda part: log.close_into(part, reached), jobs=jobs, progress=log
        )
        print_unfinished(reached, page, pdf=pdf)
        raise SystemExit(FAILED) from error


@contextmanager
def lock_folder(folder: Path) -> Iterator[None]:
    """Lock the result folder against other runs, and remove partial output of runs that were killed."""
    from sfm.files.open_folders import locked
    from sfm.files.whole_files import remove_leftovers

    with locked(folder.parent / f".{folder.name}.lock", folder):
        remove_leftovers(folder)
        yield


def stated_or_drafted(
    place: Path,
    out: Path | None,
    pitch: float | None,
    *,
    frames: int | None = None,
    overwrite: bool = False,
    edit: Callable[[str], str] | None = None,
) -> tuple[Path, Path | None, Path | None, tuple[Path, ...]]:
    """Return the survey file of what a command is given: survey file, folder of photographs, or video.

    Args:
        place: survey file, a folder, whose survey.toml is taken, or else a draft beside the result, or a
            video.
        out: see `drafted_beside`.
        pitch: see `drafted_beside`.
        frames: see `drafted_beside`.
        overwrite: see `drafted_beside`.
        edit: see `drafted_beside`.

    Returns:
        The survey file, the result folder, the folder of the photographs of a draft, else None, and the files
        that were drafted now.

    Raises:
        KolinearError: a pitch, or another number of frames, is given though the survey file exists, or see
            `drafted_beside`.
    """
    from sfm.photographs.video_files import is_video
    from sfm.products.drafting.frames_folder import frames_beside

    if is_video(place) or (place.is_dir() and not (place / SURVEY_FILE).is_file()):
        return drafted_beside(place, out, pitch, overwrite=overwrite, edit=edit, frames=frames)
    if place.is_dir():
        place = place / SURVEY_FILE
        print(f"Running {place}", file=sys.stderr)
    if place.is_file():
        refuse_pitch(pitch, place)
        refuse_frames(frames, frames_beside(place), place)
    return place, out, None, ()


class Drafted(NamedTuple):
    """A survey that was drafted, or whose draft exists."""

    file: Path  # survey file
    out: Path  # result folder
    photographs: Path  # their folder
    written: tuple[Path, ...] = ()  # by this draft, the survey file first; none if it exists


def drafted_beside(
    photographs: Path,
    out: Path | None,
    pitch: float | None,
    *,
    within: Path = Path("out"),
    overwrite: bool = False,
    edit: Callable[[str], str] | None = None,
    frames: int | None = None,
) -> Drafted:
    """Draft the survey file of a folder of photographs, unless it is already beside the result.

    Of a video, frames are written beside it, which are the photographs.

    Args:
        photographs: folder of the photographs, or a video or folder of videos.
        out: result folder; None for WITHIN/NAME OF THE FOLDER, with the name of the folder above it too where
            other photographs have this name.
        pitch: pitch of a board or plate, mm; None to assume it.
        within: folder of the results.
        overwrite: whether a result of other photographs is replaced; the survey file never is.
        edit: changes the text of a new draft; a file that exists stays as it is.
        frames: number of frames of each video; None for as many as are needed.

    Raises:
        KolinearError: there are no photographs, a pitch or another number of frames is given though the
            survey file exists, the survey file or the result is of other photographs, or the file cannot be
            written.
    """
    with loading():
        from sfm.files.open_folders import refuse_links
        from sfm.products.drafting.frames_folder import frames_beside, source_of, videos_of
        from sfm.report.output import Origin, refuse_other_origin

    name, source = None, photographs
    if out is None:
        name, out = _name_of_result(source, within)
    file = out.parent / f"{out.name}.toml"
    refuse_links(file)
    if file.exists():
        drafted_of = source_of(_drafted_of(file, out) or source)
        if drafted_of.resolve() != source.resolve():
            raise OutputError(
                f"{file}: is the survey file of the photographs in {os.path.normpath(drafted_of)} and is "
                "not replaced; choose another folder with --out, or remove the file to draft a new one"
            )
    if videos_of(source):
        photographs = frames_beside(file)
    if not overwrite:
        refuse_other_origin(out, Origin(file, photographs))
    if file.exists():
        refuse_pitch(pitch, file)
        refuse_frames(frames, photographs, file)
    photographs, name = photographs_of(source, file, frames, name)
    if file.exists():
        print(f"Running {file}, which exists; remove it to draft a new one", file=sys.stderr)
        return Drafted(file, out, photographs)
    draft = draft_folder(photographs, file, pitch, name)
    draft = draft if edit is None else replace(draft, text=edit(draft.text))
    return Drafted(file, out, photographs, write_draft(draft, photographs, file))


def _name_of_result(photographs: Path, within: Path) -> tuple[str, Path]:
    """Return the name of the survey of a folder of photographs, and its result folder.

    It is the first whose survey file is already of these photographs, else the first that no other
    photographs have.
    """
    from sfm.products.drafting.draft import names_of_folder
    from sfm.products.drafting.frames_folder import source_of
    from sfm.report.output import folder_name

    folder = photographs if photographs.is_dir() else photographs.with_suffix("")
    names = [(name, within / folder_name(name)) for name in names_of_folder(folder)]
    drafted = [_drafted_of(out.parent / f"{out.name}.toml", out) for _, out in names]
    owners = [folder if folder is None else source_of(folder) for folder in drafted]
    here = photographs.resolve()
    own = (k for k, owner in enumerate(owners) if owner is not None and owner.resolve() == here)
    free = (k for k, owner in enumerate(owners) if owner is None)
    return names[next(own, next(free, 0))]


def _drafted_of(file: Path, out: Path) -> Path | None:
    """Return the folder of photographs of a survey file beside a result, or of the result, else None."""
    from sfm.files.plain_text import read_toml
    from sfm.report.output import read_origin

    with suppress(KolinearError, KeyError, TypeError, AttributeError):  # edited by hand; its reader says so
        if file.exists():
            stated: str = read_toml(file, "a survey file")[1]["survey"]["photographs"]
            return file.parent / stated
    earlier = read_origin(out)
    return earlier.images if earlier else None


def photographs_of(
    source: Path, file: Path, frames: int | None = None, name: str | None = None
) -> tuple[Path, str | None]:
    """Return the folder of the photographs that a draft is of, and its name; of videos, take the frames.

    Args:
        source: folder of photographs, or a video or folder of videos.
        file: the survey file, beside which frames are written.
        frames: number of frames of each video; None for as many as are needed.
        name: name of the survey; None for that of the source.

    Raises:
        KolinearError: frames are asked for without a video, or a video cannot be read.
    """
    from sfm.products.drafting.draft import names_of_folder
    from sfm.products.drafting.frames_folder import frames_beside, take_frames, videos_of
    from sfm.runtime.progress_bar import drawn_progress

    if not videos_of(source):
        if frames is not None:
            raise KolinearError(f"{source}: --frames {frames} is for videos, and it is none")
        return source, name
    folder, said = frames_beside(file), list[str]()
    with working_on(str(source)), drawn_progress() as drawn:
        take_frames(source, folder, count=frames, tell=said.append, progress=drawn)
    for line in said:
        print(line, file=sys.stderr)
    return folder, name or next(names_of_folder(source if source.is_dir() else source.with_suffix("")))


def refuse_frames(frames: int | None, folder: Path, file: Path) -> None:
    """Refuse another number of frames for a survey file that exists.

    Args:
        frames: value of --frames, or None.
        folder: folder of the frames.
        file: the survey file.

    Raises:
        KolinearError: another number is given.
    """
    from sfm.products.drafting.frames_folder import count_of

    if frames is not None and frames != count_of(folder):
        raise KolinearError(
            f"{file}: --frames {frames} is for drafting a survey file, but this one exists, with its frames "
            f"in {folder}; remove both, or choose another --out"
        )


def refuse_pitch(pitch: float | None, file: Path) -> None:
    """Refuse a pitch for a survey file that exists.

    Args:
        pitch: value of --pitch, mm, or None.
        file: the survey file.

    Raises:
        KolinearError: a pitch is given.
    """
    if pitch is not None:
        raise KolinearError(
            f"{file}: --pitch {pitch:g} is for drafting a survey file, but this one exists; set "
            "targets.pitch in it, or remove it"
        )


def draft_folder(photographs: Path, file: Path, pitch: float | None = None, name: str | None = None) -> Draft:
    """Return the draft of the survey file of a folder of photographs; measures some of them.

    Args:
        photographs: the folder.
        file: path of the survey file.
        pitch: pitch of a board or plate, mm; None to assume it.
        name: name of the survey; None for that of the folder.
    """
    with loading():
        from sfm.library.surveys import sensor_widths
        from sfm.products.drafting.draft import draft_survey
        from sfm.report.output import path_from
        from sfm.runtime.progress_bar import drawn_progress
        from sfm.runtime.threads import one_blas_thread
        from sfm.survey.measuring.measured_store import MeasuredStore

    compile_first()
    unknown: list[Remark] = []
    stated = path_from(file.parent, photographs)
    with working_on(str(photographs)), drawn_progress() as drawn, one_blas_thread():
        draft = draft_survey(
            photographs,
            sensor_width=sensor_widths(unknown.append),
            pitch=pitch,
            name=name,
            stated=None if stated == os.curdir else stated,
            store=MeasuredStore.of_user(),
            progress=drawn,
        )
    return replace(draft, remarks=(*draft.remarks, *unknown))


def write_draft(draft: Draft, photographs: Path, file: Path) -> tuple[Path, ...]:
    """Write a drafted survey file, note the folder of its photographs, and report findings on stderr.

    Args:
        draft: the draft.
        photographs: folder of the photographs.
        file: the file to write.

    Returns:
        The survey file, and the picture of rings if there is one.

    Raises:
        OutputError: a name in the draft cannot be encoded.
    """
    from sfm.files.plain_text import as_plain
    from sfm.files.whole_files import whole_file
    from sfm.model.remarks.verdict import lines_of
    from sfm.survey.inputs.named_folders import note_named

    picture = file.with_name(f"{file.stem}{RINGS_PICTURE}")
    if draft.rings:
        with whole_file(picture) as part:
            part.write_bytes(draft.rings)
    with whole_file(file) as part:
        try:
            part.write_text(draft.text, encoding="utf-8")
        except UnicodeEncodeError as error:
            raise OutputError(f"{file}: a name in it cannot be encoded in UTF-8") from error
    note_named(file, photographs)
    for subject, finding in draft.found:
        print(as_plain(f"{subject}: {finding}"), file=sys.stderr)
    for line in lines_of(draft.remarks):
        mark = " " if line.severity == "note" else "!"
        print(as_plain(f"{mark} {line.text} {line.remedy}".rstrip()), file=sys.stderr)
    for name, why in draft.left_out:
        print(as_plain(f"  left out: {name}: {why}"), file=sys.stderr)
    if draft.rings:
        print(f"Rings that were not read: {picture}", file=sys.stderr)
    print(f"Survey file: {file}", file=sys.stderr)
    return (file, picture) if draft.rings else (file,)
