"""Real photographs used wrongly: random pairs of them, some resampled, two cameras under one name.

    python -m tests.survey.real_pairs

prints what each of these surveys gave; it needs the photographs of ../shared/data, and takes minutes. Every
photograph is measured once.
"""

from __future__ import annotations

import shutil
import sys
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np

from sfm.judgement.survey_result import SurveyResult
from sfm.model.errors import KolinearError
from sfm.model.similarity import fit_similarity
from sfm.pipeline import run_survey
from sfm.survey.inputs.calibration import Calibration
from sfm.survey.inputs.survey import Survey, read_survey, with_calibration
from sfm.survey.measuring.measured_store import MeasuredStore
from tests.findings import findings_of
from tests.places import DATASETS, SHARED

PAIRS, SEED = 10, 16
RESAMPLED, FACTOR = 5, 1.03
GLOBS = {"camcal": "P825*.JPG", "retro-panel": "*.tif"}


@dataclass(frozen=True)
class Outcome:
    """What a survey of real photographs gave."""

    name: str
    images: tuple[str, ...]  # that were asked for
    level: str  # good, fair, bad or refused
    reason: str  # why it was refused, or the first remarks
    points: int = 0
    sigma0_px: float = np.nan
    over_sigma: float = np.nan  # RMS difference of common points from the whole survey, over its expectation
    difference: float = np.nan  # RMS difference of these points, over their spread
    cameras: tuple[str, ...] = ()
    failed: tuple[str, ...] = ()

    def line(self) -> str:
        """Return the outcome in a line."""
        return (
            f"{self.name:12} {' '.join(self.images):44} {self.level:8} {self.points:4} points, sigma0 "
            f"{self.sigma0_px:.3f} px, {100 * self.difference:.2f} % of the spread, {self.over_sigma:.1f} "
            f"sigma; {self.reason}"
        )


def pairs_of(dataset: str, store: Path) -> Iterator[Outcome]:
    """Survey random pairs of the photographs of a dataset, and compare with the survey of all of them.

    Each is surveyed with the start values of its cameras and, marked by a star, with the calibration of all.
    """
    survey, folder = _survey(dataset), SHARED / "data" / dataset / "images"
    whole = _run(survey, folder, store)
    names = sorted(path.name for path in folder.glob(GLOBS[dataset]))
    rng = np.random.default_rng(SEED)
    every = [(a, b) for i, a in enumerate(names) for b in names[i + 1 :]]
    cameras = tuple(Calibration.of_camera(one) for one in whole.adjustment.estimate.cameras)
    calibrated = with_calibration(survey, cameras, "the whole survey")
    for k in rng.permutation(len(every))[:PAIRS]:
        yield outcome(dataset, _only(survey, every[k]), folder, store, whole, every[k])
        yield outcome(f"{dataset} *", _only(calibrated, every[k]), folder, store, whole, every[k])


def resampled(store: Path, folder: Path) -> Outcome:
    """Survey camcal with five photographs resampled by 3 % about their centre, their size kept."""
    source = SHARED / "data" / "camcal" / "images"
    files = sorted(source.glob(GLOBS["camcal"]))
    for k, path in enumerate(files):
        if k % 4 or k // 4 >= RESAMPLED:
            shutil.copy(path, folder / path.name)
            continue
        picture = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE | cv2.IMREAD_IGNORE_ORIENTATION)
        assert picture is not None
        height, width = picture.shape
        move = np.array([[FACTOR, 0, (1 - FACTOR) * width / 2], [0, FACTOR, (1 - FACTOR) * height / 2]])
        larger = cv2.warpAffine(picture, move, (width, height), flags=cv2.INTER_CUBIC)
        cv2.imwrite(str(folder / path.name), larger, [cv2.IMWRITE_JPEG_QUALITY, 95])
    survey = _survey("camcal")
    whole = _run(survey, source, store)
    return outcome("camcal 3 %", survey, folder, store, whole, ("5 of 21 resampled",))


def one_camera(store: Path) -> Outcome:
    """Survey retro-panel with its two cameras under one name."""
    survey = _survey("retro-panel")
    one = survey.cameras[0].model_copy(update={"images": ("*.tif",)})
    folder = SHARED / "data" / "retro-panel" / "images"
    return outcome(
        "one camera", replace(survey, cameras=(one,)), folder, store, None, ("043 and 671 as one",)
    )


def outcome(
    name: str,
    survey: Survey,
    folder: Path,
    store: Path,
    whole: SurveyResult | None,
    images: tuple[str, ...],
) -> Outcome:
    """Run a survey and say what came of it."""
    try:
        result = _run(survey, folder, store)
    except KolinearError as error:
        return Outcome(name, images, "refused", str(error))
    verdict = findings_of(result).verdict
    a = result.adjustment
    over, relative = _differences(result, whole) if whole is not None else (np.nan, np.nan)
    return Outcome(
        name,
        images,
        verdict.level,
        " | ".join(
            (
                *[f"{one.image}: {one.reason.text}" for one in result.failed],
                *(one.text for one in verdict.remarks),
            )
        ),
        len(a.network.points),
        a.sigma0_px,
        over,
        relative,
        tuple(camera.name for camera in a.estimate.cameras),
        tuple(one.image for one in result.failed),
    )


def _survey(dataset: str) -> Survey:
    survey = read_survey(DATASETS / dataset / "survey.toml")
    compare = survey.compare.model_copy(update={"backend": "none"})
    return replace(survey, compare=compare, control=None)


def _only(survey: Survey, names: tuple[str, ...]) -> Survey:
    """Return the survey of some photographs."""
    cameras = []
    for camera in survey.cameras:
        prefix = (camera.images or ("",))[0].split("*")[0]
        own = tuple(name for name in names if name.startswith(prefix))
        if own:
            cameras.append(camera.model_copy(update={"images": own}))
    return replace(survey, cameras=tuple(cameras))


def _run(survey: Survey, folder: Path, store: Path) -> SurveyResult:
    return run_survey(survey, images_dir=folder, store=MeasuredStore(store))


def _differences(result: SurveyResult, whole: SurveyResult) -> tuple[float, float]:
    """Return the differences of coded points after a similarity, over their sigmas and over their spread."""
    of_whole = {int(code): k for k, code in enumerate(whole.code) if code >= 0}
    rows = [k for k, code in enumerate(result.code) if int(code) in of_whole]
    if len(rows) < 4:
        return np.nan, np.nan
    mine = result.adjustment.estimate.points[rows]
    truth = whole.adjustment.estimate.points[[of_whole[int(result.code[k])] for k in rows]]
    covariance = result.adjustment.covariance.points[rows]
    moved = fit_similarity(truth, mine)
    error = moved.apply(truth) - mine
    expected = np.sqrt(np.trace(covariance, axis1=1, axis2=2).mean())
    rms = float(np.sqrt((error**2).sum(axis=1).mean()))
    spread = float(np.sqrt(((mine - mine.mean(axis=0)) ** 2).sum(axis=1).mean()))
    return rms / expected, rms / spread


def main() -> int:
    """Print the table."""
    with tempfile.TemporaryDirectory() as folder:
        store = Path(sys.argv[1]) if len(sys.argv) > 1 else Path(folder) / "store"
        for dataset in GLOBS:
            for one in pairs_of(dataset, store):
                print(one.line(), flush=True)
        print(one_camera(store).line(), flush=True)
        pictures = Path(folder) / "resampled"
        pictures.mkdir()
        print(resampled(store, pictures).line(), flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
