"""SurveyResult: the complete result of a survey, with everything that the report needs."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from datetime import date
from functools import cached_property
from pathlib import Path

import numpy as np

from sfm.adjustment.quality.correlations import ExteriorCorrelations, OrientationCorrelation
from sfm.adjustment.quality.other_solutions import OtherSolution
from sfm.adjustment.result import Adjustment
from sfm.comparison.solutions import BaselineComparison
from sfm.comparison.two_adjusters.adjusters import AdjusterComparison
from sfm.model.camera import Camera
from sfm.model.conventions import FloatArray, IntArray
from sfm.model.display import counted, html_table, in_words, text_table
from sfm.model.estimate import Estimate
from sfm.model.network import Network
from sfm.model.remarks.remark import Remark
from sfm.model.remarks.verdict import NOT_JUDGED, Verdict
from sfm.model.solution import NO_SCALE, OrientedImage, Point, PointTable, SeenTargets, Solution
from sfm.targets.outlines import LIKELIEST_FIRST, Flag, count_flags


@dataclass(frozen=True)
class FailedImage:
    """A photograph that is not part of the result."""

    image: str  # name of the photograph
    reason: Remark  # what was found and what was needed

    @property
    def is_copy(self) -> bool:
        """Whether it is a copy of another photograph, which is used instead."""
        return self.reason.kind == "copies"

    @property
    def is_unreadable(self) -> bool:
        """Whether the file cannot be read, so that it may be no photograph."""
        return self.reason.kind == "photographs_unreadable"

    @property
    def is_counted(self) -> bool:
        """Whether it counts as a photograph: copies, and files that are not here or not readable, do not."""
        return not (self.is_copy or self.is_unreadable or self.reason.kind == "photographs_without_file")


@dataclass(frozen=True)
class LeftOutPoint:
    """A measured point that is not part of the result."""

    point: str  # name of the point
    image_points: int  # number of its image points
    reason: Remark  # what was found and what was needed


@dataclass(frozen=True)
class GivenTest:
    """Test of one kind of given values against the free network."""

    what: str  # scale, control points or projection centres
    statistic: float | None  # chi-square; None if the values have no standard deviations
    dof: int
    probability: float  # of such differences by chance
    others: int | None = None  # values that each is compared with if these have no standard deviations
    judged: int | None = None  # values that are judged where these are only some of very many
    given: int | None = None  # all of them, then


@dataclass(frozen=True)
class StageTime:
    """Duration of a stage."""

    stage: str
    seconds: float


@dataclass(frozen=True)
class PhotographTargets:
    """Measured targets and rejected candidates of one photograph, for its overlay."""

    image: str  # name of the photograph
    path: Path  # its file
    xy: FloatArray  # centres of the measured targets, pixel frame, px, (k, 2)
    semi_axes: FloatArray  # semi-axes of their outlines, larger first, px, (k, 2)
    angle: FloatArray  # angle of the larger semi-axis from x towards y, rad, (k,)
    rejected_xy: FloatArray  # centres of the rejected candidates, px, (r, 2)
    rejected_flag: IntArray  # reason for each rejection, see sfm.targets.outlines.Flag, (r,)
    flag: IntArray | None = None  # remarks on the measured targets, see sfm.targets.outlines.Flag, (k,)
    stored: bool = False  # whether the targets were measured in an earlier run
    blur: FloatArray | None = None  # standard deviation of their edges, px; NaN where unknown, (k,)
    camera: str = ""  # name of the camera; each camera has photographs of one size

    def with_more(self, other: PhotographTargets) -> PhotographTargets:
        """Return the overlay with the image points of another source as well."""
        drawn = (self, other)
        flags = [np.zeros(len(part.xy), np.int64) if part.flag is None else part.flag for part in drawn]
        blurs = [np.full(len(part.xy), np.nan) if part.blur is None else part.blur for part in drawn]
        return replace(
            self,
            xy=np.concatenate([self.xy, other.xy]),
            semi_axes=np.concatenate([self.semi_axes, other.semi_axes]),
            angle=np.concatenate([self.angle, other.angle]),
            rejected_xy=np.concatenate([self.rejected_xy, other.rejected_xy]),
            rejected_flag=np.concatenate([self.rejected_flag, other.rejected_flag]),
            flag=np.concatenate(flags),
            stored=self.stored and other.stored,
            blur=np.concatenate(blurs),
        )

    def reasons(self) -> list[tuple[str, int]]:
        """Return (reason, number of candidates) of this photograph, most frequent first."""
        return [(name.replace("_", " "), count) for name, count in count_flags(self.rejected_flag)]


@dataclass(frozen=True)
class ControlCheck:
    """Differences at control points that took no part in the adjustment, after a similarity onto them."""

    points: tuple[str, ...]  # names of the control points that were measured, (n,)
    differences: FloatArray  # transformed minus nominal X, Y, Z, object unit, (n, 3)
    scale: float  # scale of the control over that of the adjusted network; 1 where it came from the control

    @property
    def rms(self) -> FloatArray:
        """Root mean square difference in X, Y, Z, object unit, (3,)."""
        return np.asarray(np.sqrt((self.differences**2).mean(axis=0)))


@dataclass(frozen=True)
class Eccentricity:
    """Corrections of image points because the image of a circle's centre is not the centre of its ellipse."""

    largest_px: float  # longest correction, px
    rms_px: float  # root mean square per coordinate, px
    sigma_px: float  # root mean square of the standard deviations of a corrected coordinate, px


@dataclass(frozen=True)
class CheckPoint:
    """A point with known coordinates that took no part in the adjustment."""

    point: str
    xyz: FloatArray  # object unit, NaN where the coordinate took part or is unknown, (3,)
    sigma: FloatArray  # stated standard deviations, object unit, (3,)


@dataclass(frozen=True)
class SeenPlate:
    """A calibration plate with points in the result."""

    points: IntArray  # indices in the network of the result, (n,)
    sigma: float  # standard deviation of its coordinates, object unit


@dataclass(frozen=True)
class PlacedEquipment:
    """A bar or frame of the equipment file in one of the positions where it was photographed."""

    name: str  # name in the equipment file
    given_as: str  # scale bar | rigid frame, followed by its name among the given values
    calibrated: date
    calibration_temperature: float  # deg C
    expansion: float  # expansion coefficient, 1e-6 per K
    expansion_sigma: float  # standard deviation of the expansion coefficient, 1e-6 per K
    temperature: float  # temperature in the survey, deg C
    temperature_sigma: float  # standard deviation of the temperature, K
    correction: float  # correction of its lengths from calibration to survey, 1e-6


@dataclass(frozen=True, repr=False, eq=False)
class SurveyResult:
    """Result of a survey: the adjustment and the information needed to judge it.

    Example:
        >>> import sfm
        >>> result = sfm.run_survey(sfm.read_survey(observed_survey), compare_with="none")
        >>> result.point("1").covariance.shape, result.image("image 1").sigma.shape
        ((3, 3), (6,))
    """

    survey: str  # name of the survey
    unit: str  # object unit
    images_total: int  # photographs that the survey names, without copies and files that cannot be read
    failed: tuple[FailedImage, ...]  # photographs that could not be read or oriented, with the reason
    adjustment: Adjustment  # adjustment in the datum and with the control that the survey specifies
    code: IntArray  # code number of each point of adjustment.network, -1 = uncoded, (n,)
    comparison: AdjusterComparison | None  # comparison with the other adjuster; None if not requested
    baseline: BaselineComparison | None = None  # comparison with another pipeline; None if not requested
    photographs: tuple[PhotographTargets, ...] = ()  # all readable photographs; none with [observations]
    control_check: ControlCheck | None = None  # None without control, or where the datum is control
    stage_remarks: tuple[Remark, ...] = ()  # remarks of its stages
    verdict: Verdict = NOT_JUDGED  # level, headline and all remarks
    eccentricity: Eccentricity | None = None  # None where it was not corrected
    no_circles: tuple[str, ...] = ()  # uncoded points left out: their outlines are not images of one circle
    left_out: tuple[LeftOutPoint, ...] = ()  # measured points that are not in the result
    given_tests: tuple[GivenTest, ...] = ()  # tests of control and scale bars against the image points alone
    other_solutions: tuple[OtherSolution, ...] = ()  # further solutions that fit the image points
    unused_image_points: int = 0  # their point, photograph or state is not in the result; in no other count
    plates: tuple[SeenPlate, ...] = ()  # plates whose points are known relative to one another
    check_points: tuple[CheckPoint, ...] = ()  # points with coordinates that took no part
    equipment: tuple[PlacedEquipment, ...] = ()  # calibrated equipment, once for each position
    balance_radius_mm: tuple[tuple[str, float], ...] = ()  # R0 of the cameras given in AICON's form
    exterior_correlations: ExteriorCorrelations | None = None  # correlations of all camera parameters
    # strong correlations between camera parameters and exterior orientation
    orientation_correlations: tuple[OrientationCorrelation, ...] = ()
    seconds: tuple[StageTime, ...] = ()  # computing time of each stage, in order
    settings: tuple[tuple[str, str], ...] = ()  # (table of the survey file, its content)
    weights: str = "components"  # weighting of image points and other observations: components | stated
    reject: str = "tau"  # how the survey treats gross errors: tau | huber | tukey | none

    @property
    def name(self) -> str:
        """Name of the survey."""
        return self.survey

    @property
    def remarks(self) -> tuple[Remark, ...]:
        """All remarks of the verdict, the most serious first."""
        return self.verdict.remarks

    @property
    def tests(self) -> tuple[Remark, ...]:
        """What was tested, and what could not be."""
        return self.verdict.tests

    @property
    def network(self) -> Network:
        """The adjusted network, including rejected image points."""
        return self.adjustment.network

    @property
    def estimate(self) -> Estimate:
        """Adjusted cameras, orientations and points."""
        return self.adjustment.estimate

    @cached_property
    def seen_targets(self) -> SeenTargets:
        """Measured targets and rejected candidates in the photographs of the result."""
        index = {name: i for i, name in enumerate(self.network.images)}
        of_index = [photograph for photograph in self.photographs if photograph.image in index]
        of_index.sort(key=lambda photograph: index[photograph.image])
        image, xy, ellipses, reasons = list[int](), [np.zeros((0, 2))], [np.zeros((0, 3))], list[str]()
        for photograph in of_index:
            measured, rejected = len(photograph.xy), len(photograph.rejected_xy)
            image += [index[photograph.image]] * (measured + rejected)
            xy += [photograph.xy, photograph.rejected_xy]
            ellipses += [np.column_stack([photograph.semi_axes, photograph.angle])]
            ellipses += [np.full((rejected, 3), np.nan)]
            reasons += [""] * measured + [
                in_words(Flag, flag) or "no reason kept" for flag in photograph.rejected_flag.tolist()
            ]
        return SeenTargets(
            np.array(image, dtype=np.int64), np.vstack(xy), np.vstack(ellipses), tuple(reasons)
        )

    @cached_property
    def solution(self) -> Solution:
        """The accepted image points, with their solution and covariance."""
        return replace(self.adjustment.solution, name=self.survey, unit=self.length_unit, judged=self.verdict)

    @property
    def points(self) -> PointTable:
        """The adjusted object points, by name."""
        return self.solution.points

    def point(self, name: str | int) -> Point:
        """Return an object point; UnknownNameError if no point has that name."""
        return self.solution.point(name)

    def image(self, name: str) -> OrientedImage:
        """Return the exterior orientation of a photograph; UnknownNameError if no such photograph exists."""
        return self.solution.image(name)

    def camera(self, name: str) -> Camera:
        """Return an adjusted camera; UnknownNameError if no camera has that name."""
        return self.solution.camera(name)

    def write(self, folder: str | Path, *, pictures_mb: float = 15.0) -> Path:
        """Write tables, figures and the report into a folder, whole or not at all; return report.html.

        Args:
            folder: an earlier result in it is replaced; any other content is an error.
            pictures_mb: limit for the pictures inside report.html, 10^6 bytes; the rest goes to pictures/.

        Raises:
            OutputError: the folder cannot be written, or contains anything but an earlier result.
        """
        import sfm  # the report is in a layer above this one, so it is called by its public name

        page: Path = sfm.write_result(self, folder, pictures_mb=pictures_mb)
        return page

    def _rows(self) -> list[tuple[str, str]]:
        a = self.adjustment
        sigma = np.sqrt(np.nanmean(np.diagonal(a.covariance.points, axis1=1, axis2=2), axis=0))
        state = "converged" if a.converged else "did NOT converge"
        comparison = self.comparison
        rows = [
            ("photographs", f"{len(a.network.images)} of {self.images_total} oriented"),
            ("points", f"{len(a.network.points)}, {int((self.code >= 0).sum())} coded"),
            ("image points", self.image_point_counts),
            ("adjustment", f"{state}, datum {a.datum}, redundancy {a.redundancy}"),
            ("sigma0", f"{a.sigma0_px:.4f} px"),
            ("RMS sigma of points", f"{', '.join(f'{s:.3g}' for s in sigma)} {self.length_unit}"),
        ]
        if comparison is not None:
            rows.append((comparison.backend, comparison.outcome))
        return rows

    def __repr__(self) -> str:
        table = text_table(f"Survey {self.survey}", ("", ""), self._rows())
        return f"{table}\n{self.verdict.text}"

    def _repr_html_(self) -> str:
        remarks = [(line.severity, line.text) for line in self.verdict.lines]
        rows = [("verdict", self.verdict.headline), *self._rows(), *remarks]
        return html_table(f"Survey {self.survey}", ("", ""), rows)

    @property
    def point_counts(self) -> str:
        """Numbers of coded points, and of the others by the first of their sources, in words."""
        network, coded = self.adjustment.network, np.asarray(self.code) >= 0
        first = np.full(len(coded), len(network.sources))
        np.minimum.at(first, network.image_points.point, network.source)
        counts = {"coded": int(coded.sum())} if coded.any() else {}
        for k, source in enumerate(network.sources):
            count = int((first[~coded] == k).sum())
            if count:
                counts[source.points] = counts.get(source.points, 0) + count
        return ", ".join(f"{count} {what}" for what, count in counts.items())

    @property
    def image_point_counts(self) -> str:
        """Numbers of accepted, rejected and unused image points, in words."""
        rejected = int(self.adjustment.rejected.sum())
        words = f"{len(self.adjustment.rejected) - rejected} accepted, {rejected} rejected"
        unused = self.unused_image_points
        if not unused:
            return words
        of_points = f" (of {counted(len(self.left_out), 'point')})" if self.left_out else ""
        return f"{words}, {unused} not in the result{of_points}"

    @property
    def has_scale(self) -> bool:
        """Whether lengths are in the object unit: from control or scale bars, or by placement on control."""
        return self.adjustment.has_scale

    @property
    def length_unit(self) -> str:
        """Unit of lengths: the object unit, or network units where the scale is undefined."""
        return self.unit if self.has_scale else NO_SCALE


def sort_likeliest_first(reasons: Iterable[str]) -> list[str]:
    """Sort reasons for rejection so that reasons for the most target-like candidates come first.

    Reasons that do not concern a candidate, such as a target measured but not used, precede them all.
    """
    rank = {in_words(Flag, flag): k for k, flag in enumerate(LIKELIEST_FIRST)}
    return sorted(reasons, key=lambda reason: (rank.get(reason, -1), reason))
