"""Result of an adjustment: the solution, its statistics and its covariance."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np

from sfm.conventions import BoolArray, FloatArray, IntArray
from sfm.display import counted, html_table, text_table
from sfm.network import Estimate, Network, values_of
from sfm.observations.kind import Group
from sfm.remarks.remark import Remark
from sfm.solution import NO_SCALE, OBJECT_UNITS, Solution, mount_blocks

# Of an image coordinate. Computed ones are exact to some 1e-15 of themselves, and to 1e-10 where errors of
# control strain their network; measured ones to 1e-7 at best.
ROUNDING = 1e-9
MOTIONS = 7  # position, attitude and scale: what image points leave open
# Standard deviation of an image coordinate that no measurement beats: targets reach 1/100 px, computed images
# 1/1000. Beside larger weights, control and bars of a usual survey would be lost in rounding. Source: Luhmann
# et al. (2020), Close-Range Photogrammetry, sec. 5.4.2.
MIN_SIGMA_PX = 1e-3


@dataclass(frozen=True)
class Covariance:
    """Marginal covariance of the unknowns, scaled by sigma0^2 a posteriori, in the datum adjusted in."""

    points: FloatArray  # of X, Y, Z of each object point, object unit^2, (n, 3, 3)
    exterior: FloatArray  # of X0, Y0, Z0 (object unit) and omega, phi, kappa (rad), (m, 6, 6)
    interior: tuple[FloatArray, ...]  # of the free parameters of each camera, in order; the variance of one
    # that is not determined is infinite, (f, f)
    points_limiting: FloatArray  # of points with the cameras held fixed, object unit^2, (n, 3, 3)
    rigs: FloatArray = field(
        default_factory=lambda: np.zeros((0, 0))
    )  # of `interior` of all cameras and then
    # X, Y, Z (object unit), omega, phi, kappa (rad) of each in its rig, together; none without rigs, (s, s)

    @property
    def mounts(self) -> FloatArray:
        """Covariance of X, Y, Z, omega, phi, kappa of each camera in its rig; 0 of references, (a, 6, 6)."""
        return mount_blocks(self.rigs, sum(map(len, self.interior)))


@dataclass(frozen=True)
class ErrorCorrelation:
    """Errors of image points that neighbours in a photograph have in common, and those that each has alone.

    Each alone has `alone` times its variance a posteriori. Common errors move neighbours by as many
    px, precise ones and others, x and y alike: their covariance in one photograph is
    `common` exp(-d / length_px) at distance d.
    """

    alone: float  # variance over that a posteriori
    common: float  # over sigma0_px^2, that of a usual image point
    length_px: float  # distance at which the common part has fallen to 1/e

    def sigmas_px(self, sigma0_px: float) -> tuple[float, float]:
        """Return the standard deviations of what an image coordinate has alone and of the common part, px."""
        return self.alone**0.5 * sigma0_px, self.common**0.5 * sigma0_px


@dataclass(frozen=True)
class ObservedResiduals:
    """Residuals of the observations of one kind beside image points that took part in an adjustment."""

    index: int  # of their kind among `Network.kinds`
    rows: IntArray  # which of its observations took part, (n,)
    difference: FloatArray  # computed minus observed, (n, d)
    redundancy_numbers: FloatArray  # 0 to 1; NaN where a component was not observed, (n, d)
    standardised: FloatArray  # Baarda's w for sigma0 = 1; NaN where a component has no check, (n, d)
    count: int  # scalar observations
    vPv: float
    redundancy: float  # of all of them; NaN without covariance


class GroupParameters(NamedTuple):
    """Parameters that a group of observations finds, such as an additive constant or the tip of a probe."""

    group: str
    names: tuple[str, ...]  # (h,)
    value: FloatArray  # object unit, (h,)
    covariance: FloatArray  # infinite variances where they are not determined, (h, h)


@dataclass(frozen=True, repr=False)
class Adjustment:
    """Result of a least-squares adjustment of a network.

    Example:
        >>> import sfm
        >>> adjustment = sfm.adjust(result.network, result.estimate, reject="none")
        >>> adjustment.datum, adjustment.rejected.any(), adjustment.covariance.points.shape
        ('free', np.False_, (20, 3, 3))
    """

    network: Network  # as stated, rejected image points included
    estimate: Estimate  # adjusted interior and exterior orientation and points
    converged: bool  # whether the criterion of convergence was met
    iterations: int  # steps taken
    datum: str  # free | minimal | control
    defect: int  # rank defect of the normal equations without datum, found numerically
    expected_defect: int  # the defect that the kind of datum leaves to it
    undetermined: tuple[str, ...]  # parameters that cannot be determined, in words; empty if none
    residuals: FloatArray  # v = computed - measured, px, pixel frame, rejected ones included, (k, 2)
    rejected: BoolArray  # image points that took no part, (k,)
    redundancy_numbers: FloatArray  # of each image coordinate, 0 to 1; NaN where rejected, (k, 2)
    sigma_px: float  # a priori standard deviation of unit weight, px
    sigma0: float  # a posteriori over a priori standard deviation of unit weight, `inflation` included
    redundancy: int  # observations and constraints minus unknowns
    unknowns: int  # all adjusted parameters
    observations: int  # scalar observations used: image coordinates and those of other kinds
    covariance: Covariance
    standardised: FloatArray = field(default_factory=lambda: np.zeros((0, 2)))  # Baarda's w of each image
    # coordinate, v over its a priori standard deviation; of rejected ones as predicted, (k, 2)
    residual_weights: FloatArray = field(default_factory=lambda: np.zeros((0, 2)))  # diagonal of P Qvv P of
    # each image point, Qvv the cofactors of its residual; NaN where rejected, px^-2, (k, 2)
    weights: FloatArray = field(default_factory=lambda: np.zeros(0))  # factor on the weight of each image
    # point: 0 where rejected, between 0 and 1 by reweighting, else 1, (k,)

    inflation: float = 1.0  # of standard deviations by an M-estimator, over those that v'Pv with its weights
    # gives; see `robust.inflation`; 1 with least squares
    observed: tuple[ObservedResiduals, ...] = ()  # residuals of the observations beside image points
    image_sigma_factor: FloatArray = field(default_factory=lambda: np.ones(0))  # by which the stated standard
    # deviations of each image point were multiplied for its weight, (k,)
    datum_points: BoolArray | None = None  # object points that carry the datum; all if None, (n,)
    unknown_counts: tuple[int, int, int] = (0, 0, 0)  # of exterior orientation, interior orientation, points
    test_alpha: float = 0.001  # probability with which the test that was applied rejects a good image
    # coordinate; Baarda's usual one where none was
    start_sigma0: float = float("nan")  # as sigma0, at the start values
    remarks: tuple[Remark, ...] = ()  # what of the robust test could not be carried through
    error_correlation: ErrorCorrelation | None = None  # of neighbours, that the covariance has in it
    independent: Covariance | None = None  # covariance without that correlation, None where there is none

    @cached_property
    def solution(self) -> Solution:
        """The accepted image points, with their solution and covariance."""
        from sfm.adjustment.covariance import JointOnDemand

        exterior = self.covariance.exterior
        return Solution(
            "adjustment",
            replace(self.network, image_points=self.network.image_points.select(~self.rejected)),
            self.estimate,
            self.covariance.points,
            exterior[:, :3, :3],
            tuple(self.interior_sigma(k) for k in range(len(self.estimate.cameras))),
            self.redundancy,
            OBJECT_UNITS if self.has_scale else NO_SCALE,
            datum=self.datum,
            exterior_covariance=exterior,
            interior_covariance=self.covariance.interior,
            rig_covariance=self.covariance.rigs if len(self.covariance.rigs) else None,
            joint=JointOnDemand(self),
        )

    @property
    def group_parameters(self) -> tuple[GroupParameters, ...]:
        """Parameters of groups of observations that a survey is made to find, with their covariance."""
        found: list[GroupParameters] = []
        for group in self.network.observations:
            if isinstance(group, Group) and group.reported and len(group):
                fitted = group.own_parameters(values_of(self.estimate))
                J = fitted.J.reshape(len(fitted.J), -1)
                C = self.solution.covariance_of([self.network.points[j] for j in group.point])
                C = self.sigma0**2 * fitted.cofactor + J @ C @ J.T
                found.append(GroupParameters(group.group, group.reported, fitted.value, C))
        return tuple(found)

    @property
    def has_scale(self) -> bool:
        """Whether lengths are in the object unit: from what was given, or placed on control."""
        given = self.datum == "control" or self.expected_defect < MOTIONS or len(self.network.scale_bars) > 0
        return given or len(self.network.control) >= 2

    @property
    def vPv(self) -> float:
        """Weighted sum of squared residuals of all observations, a priori unit weight."""
        return (self.sigma0 / self.inflation) ** 2 * self.redundancy

    @property
    def cofactors(self) -> Covariance:
        """Covariance of independent errors for sigma0 = 1, which the weights of the adjustment mean."""
        c, unit = self.covariance if self.independent is None else self.independent, self.sigma0**2
        return Covariance(
            c.points / unit,
            c.exterior / unit,
            tuple(Q / unit for Q in c.interior),
            c.points_limiting / unit,
            c.rigs / unit,
        )

    @property
    def reweighted(self) -> bool:
        """Whether the weights of image points come from their residuals, as with an M-estimator."""
        return self.inflation != 1.0

    @property
    def steps(self) -> str:
        """How many iterations there were, in words; the start values of a survey are adjusted already."""
        return (
            counted(self.iterations, "iteration")
            if self.iterations
            else "0 further iterations after the orientation"
        )

    @property
    def tau(self) -> FloatArray:
        """Pope's tau of each image coordinate: Baarda's w over their sigma0 a posteriori, (k, 2)."""
        return self.standardised / self.image_sigma0

    @property
    def image_sigma0(self) -> float:
        """As sigma0, of the image points by themselves: the stated precision of others has no effect."""
        used, r = ~self.rejected, float(np.nansum(self.redundancy_numbers))
        if not r > 0:
            return self.sigma0
        v, P = self.residuals[used], np.linalg.inv(self.image_covariance[used])
        vPv = float(self.weights[used] @ np.einsum("ka,kab,kb->k", v, P, v))
        return self.inflation * float(np.sqrt(vPv / r))

    @property
    def image_covariance(self) -> FloatArray:
        """Covariance by which image points were weighted, stated times factor squared, px^2, (k, 2, 2)."""
        return scaled_covariance(self.network.image_points.covariance, self.image_sigma_factor)

    @property
    def weight_factor(self) -> float:
        """Factor on the stated standard deviations of the image points, the median where it differs."""
        return float(np.median(self.image_sigma_factor))

    @property
    def sigma0_px(self) -> float:
        """A posteriori standard deviation of an image coordinate, the median of the accepted, px."""
        return self.sigma0 * self.usual_px

    @property
    def usual_px(self) -> float:
        """A priori standard deviation of an image coordinate, the median of the accepted, px."""
        return _median_sigma(self.image_covariance[~self.rejected])

    @property
    def stated_px(self) -> float:
        """Stated standard deviation of an image coordinate, the median of the accepted, px."""
        return _median_sigma(self.network.image_points.covariance[~self.rejected])

    @property
    def rms_px(self) -> float:
        """Root mean square residual per coordinate over the accepted image points, px."""
        used = self.residuals[~self.rejected]
        return float((used**2).mean() ** 0.5)

    @property
    def is_exact(self) -> bool:
        """Whether the accepted residuals are rounding: of image points without noise, which test nothing."""
        return bool(self.rms_px <= ROUNDING * np.abs(self.network.image_points.xy).max())

    @property
    def max_residual_px(self) -> float:
        """Longest residual vector among the accepted image points, px."""
        used = self.residuals[~self.rejected]
        return float((used**2).sum(axis=1).max() ** 0.5)

    def interior_sigma(self, camera: int) -> FloatArray:
        """Return the standard deviation of each parameter of a camera, (p,).

        It is NaN for those not adjusted, and infinite for those that are not determined.
        """
        free = np.flatnonzero(self.estimate.cameras[camera].free)
        sigma = np.full(len(self.estimate.cameras[camera].free), np.nan)
        variance = np.diagonal(self.covariance.interior[camera])
        if len(variance):  # a camera without photographs in the network has none
            sigma[free] = np.sqrt(np.where(variance >= 0, variance, np.nan))
        return sigma

    def _rows(self) -> list[tuple[str, str]]:
        state = "converged" if self.converged else "did NOT converge"
        rows = [
            ("state", f"{state}, {self.steps}"),
            ("datum", f"{self.datum}, rank defect {self.defect} (expected {self.expected_defect})"),
            ("image points", f"{int((~self.rejected).sum())} accepted, {int(self.rejected.sum())} rejected"),
            ("sigma0", f"{self.sigma0_px:.4f} px, redundancy {self.redundancy}"),
        ]
        return rows + [("undetermined", name) for name in self.undetermined]

    def __repr__(self) -> str:
        return text_table("Adjustment", ("", ""), self._rows())

    def _repr_html_(self) -> str:
        return html_table("Adjustment", ("", ""), self._rows())


def scaled_covariance(covariance: FloatArray, sigma_factor: FloatArray) -> FloatArray:
    """Return covariances (k, 2, 2) of standard deviations multiplied by a factor of each, (k,)."""
    return np.asarray(covariance * sigma_factor[:, None, None] ** 2)


def _median_sigma(covariance: FloatArray) -> float:
    """Return that of a coordinate, NaN of none: a few image points of little weight do not change it."""
    if not len(covariance):
        return float("nan")
    return float((np.median(np.trace(covariance, axis1=1, axis2=2)) / 2) ** 0.5)
