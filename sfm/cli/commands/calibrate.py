"""The command `calibrate`: from photographs of a board, plate, tags or targets to a judged camera."""

from __future__ import annotations

import math
import re
import sys
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from sfm.cli.options import Jobs, Out, Overwrite, Pdf, Pitch, SurveyOrPhotographs
from sfm.cli.survey_runs import RunOptions, run_survey_file, stated_or_drafted
from sfm.cli.watching import WatchedSurvey, run_or_watch
from sfm.model.errors import KolinearError

if TYPE_CHECKING:
    from sfm.judgement.survey_result import SurveyResult
    from sfm.products.calibration.calibration import Calibration
    from sfm.report.page import Page

SHOWN = ("trust", "next")  # sections of the page that are printed
SIGMA_ADDED = "  # ADDED: the image points contradict a true plate"


def calibrate(
    photographs: SurveyOrPhotographs,
    out: Out = None,
    model: Annotated[
        str | None,
        typer.Option(
            "--model",
            metavar="NAME",
            help="Camera model of a drafted survey file.  [default: the one that the photographs favour]",
        ),
    ] = None,
    distance: Annotated[
        list[float] | None,
        typer.Option(
            "--distance",
            metavar="D",
            help="Distance from the camera, in the unit of the survey, at which the uncertainty of "
            "projection is stated; may be repeated. Infinity is always added.  [default: that of the object]",
        ),
    ] = None,
    pitch: Pitch = None,
    watched: Annotated[
        bool,
        typer.Option(
            "--watch",
            help="Calibrate again whenever photographs are added to the folder, and say which one is next.",
        ),
    ] = False,
    until: Annotated[
        float,
        typer.Option(
            "--until",
            metavar="PX",
            min=0.0,
            help="Uncertainty of the worst corner, far points, 1 sigma, at which --watch ends.",
        ),
    ] = 0.0,
    export: Annotated[
        Path | None,
        typer.Option(
            "--export",
            metavar="FILE",
            help="Write the cameras of a dependable calibration into this new file too, as by kolinear "
            "convert.",
        ),
    ] = None,
    to: Annotated[
        str, typer.Option("--to", metavar="FORMAT", help="Format of --export, one of cameras.")
    ] = "opencv-camera",
    overwrite: Overwrite = False,
    jobs: Jobs = None,
    pdf: Pdf = False,
) -> None:
    """Calibrate cameras from photographs, and judge the result.

    The survey is run as by `kolinear run`. One more page in the folder of the result, calibration.html,
    states whether the cameras can be trusted, where, what is wrong, and which photographs would help most;
    calibration.json has the same for programs. Where a plate is not as given, its points are adjusted.

    With --watch each photograph that is added to the folder is used at once: what it brought, how well the
    camera is known so far, and how to take the next one.

    Exit code 0 with a dependable calibration, with or without remarks; 1 if it is not dependable, for the
    reasons on the page, or a stage cannot go on; 2 if the input must be corrected.
    """
    distances = tuple(distance or ())
    for value in distances:
        if not value > 0:
            raise KolinearError(f"--distance {value:g}, expected more than 0")
    if model is not None:
        from sfm.model.distortion.models import MODELS

        if model not in MODELS:
            raise KolinearError(f"--model '{model}', expected one of {', '.join(MODELS)}")
    if export is not None:
        from adapters.formats.cameras.registry import camera_format
        from sfm.files.whole_files import refuse_existing

        if watched:
            raise KolinearError("--export is not for --watch; use kolinear convert on the result")
        camera_format(to)
        refuse_existing(export)
    product = _Product(distances=distances, until=until, is_watched=watched, export=export, to=to)

    def edit(text: str) -> str:
        return _for_calibration(text, model)

    def run_once() -> None:
        stays = product.begin()
        survey_file, folder, images, written = stated_or_drafted(
            photographs, out, None if stays else pitch, overwrite=overwrite, edit=edit
        )
        product.note_drafted(written)
        asked = model is not None and survey_file.is_file()
        if asked and f'model = "{model}"' not in survey_file.read_text(encoding="utf-8"):
            raise KolinearError(
                f"{survey_file}: --model {model} is for drafting a survey file, but this one exists; set "
                "model in it, or remove it"
            )
        options = RunOptions(
            images=images,
            out=folder,
            jobs=jobs,
            from_photographs=None if images is None else True,
            overwrite=overwrite,
            pictures_mb=15.0,
            pdf=pdf,
            product=product,
        )
        run_survey_file(survey_file, options)

    run_or_watch(photographs, run_once, product)


def _for_calibration(text: str, model: str | None) -> str:
    """Return a drafted survey file without comparison, and with the model that is asked for."""
    none = 'backend = "none"  # "colmap" adjusts with COLMAP too'
    text = re.sub(r'^backend = ".*$', none, text, flags=re.M)
    if model is not None:
        text = re.sub(r"^free = .*\n", "", text, flags=re.M)  # the program chooses those of the model
        text = re.sub(r'^(?:# )?model = ".*$', f'model = "{model}"', text, flags=re.M)
    return text


@dataclass
class _Product(WatchedSurvey):
    """The calibration of a survey."""

    distances: tuple[float, ...] = ()
    calibration: Calibration | None = None  # once it is written
    page: Page | None = None
    export: Path | None = None  # file for another program
    to: str = ""  # its format

    def revise(self, survey_file: Path, result: SurveyResult) -> bool:
        """Free the points of a plate that is not as given, with the precision that the image points show."""
        text = survey_file.read_text(encoding="utf-8")
        shape = next((said for said in result.remarks if said.kind == "shape_of_control"), None)
        if not self.drafted or shape is None or re.search(r"^plate_sigma", text, re.M):
            return False
        sigma = shape.number("sigma")
        if not sigma > 0:
            return False
        row = f"plate_sigma = {sigma:.3g}"
        added = re.sub(r"^(pitch = .*\n)", rf"\1{row}{SIGMA_ADDED}\n", text, count=1, flags=re.M)
        if added == text:
            return False
        from sfm.files.whole_files import whole_file

        with whole_file(survey_file, replaces=True) as part:
            part.write_text(added, encoding="utf-8")
        self.own[survey_file] = survey_file.read_bytes()
        print(f"{survey_file}: {shape.text} {row} was added.", file=sys.stderr)
        return True

    def write(self, result: SurveyResult, part: Path, folder: Path) -> None:
        """Write the page of the calibration and its files."""
        from sfm.library.surveys import write_result
        from sfm.products.calibration.calibration import calibrate as calibrated
        from sfm.products.calibration.page import splined_folder
        from sfm.report.pages import page_of, texts_of

        self.result, self.calibration = result, calibrated(result, self.distances)
        self.page = page_of(self.calibration, folder=str(folder))
        for name, content in texts_of(self.page).items():
            (part / name).write_text(content, encoding="utf-8", newline="")
        for camera in self.calibration.cameras:
            if camera.splined is not None:
                solution = replace(
                    camera.splined.adjustment.solution, name=result.survey, unit=result.length_unit
                )
                write_result(solution, part / splined_folder(camera))

    def show(self, folder: Path, *, pdf: bool = False) -> bool:
        """Print the verdict and the figures of the cameras."""
        from sfm.cli.console import print_page, print_verdict
        from sfm.files.plain_text import as_plain
        from sfm.report.page import Heading, Statement, Table

        declared = self.page
        assert declared is not None
        print_verdict(declared.verdict)
        self.is_dependable = declared.verdict.level != "bad"
        if self.is_watched:
            print_page("Calibration", folder / declared.path, pdf=pdf)
            return self.is_dependable
        for part in (part for section in declared.sections if section.key in SHOWN for part in section.parts):
            if isinstance(part, Heading | Statement):
                print(as_plain(part.text))
            elif isinstance(part, Table):
                print("".join(f"  {line}\n" for line in part.text.splitlines()), end="")
        print_page("Report", folder / "report.html", pdf=pdf)
        print_page("Calibration", folder / declared.path, pdf=pdf)
        if self.export is not None and self.is_dependable:
            from sfm.cli.written_cameras import write_camera_files

            print(write_camera_files(folder, self.export, self.to))
        return self.is_dependable

    def uncertainty(self) -> float:
        """Return that of the worst corner of any camera, far points, px."""
        cameras = self.calibration.cameras if self.calibration is not None else ()
        return max((camera.next.before for camera in cameras), default=math.nan)

    def so_far(self) -> Iterator[str]:
        """Yield the uncertainty of each camera, and the view that lowers it most."""
        from sfm.model.remarks.row import significant
        from sfm.products.calibration.page import pose_words

        if self.calibration is None or self.result is None:
            return
        for camera in self.calibration.cameras:
            wanted = f", wanted {significant(self.until)} px" if self.until else ""
            yield f"{camera.name}: worst corner {significant(camera.next.before)} px{wanted}"
            for pose, after in zip(camera.next.poses[:1], camera.next.after, strict=False):
                words = pose_words(pose, self.result.length_unit)
                yield f"  next: {words}; worst corner then {significant(after)} px"
