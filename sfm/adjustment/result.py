"""Result of an adjustment: the solution, its statistics and its covariance."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cached_property, partial, wraps
from typing import Concatenate, NamedTuple, ParamSpec, TypeVar

import numpy as np

from sfm.adjustment.engine.unknowns import scaled_covariance
from sfm.model.conventions import BoolArray, FloatArray, IntArray
from sfm.model.display import counted, html_table, text_table
from sfm.model.distributions import FALSE_ALARM, LEVEL, Levels
from sfm.model.estimate import Estimate, values_of
from sfm.model.network import Network
from sfm.model.observations.kind import Group
from sfm.model.remarks.remark import Remark
from sfm.model.remarks.verdict import Verdict
from sfm.model.solution import NO_SCALE, OBJECT_UNITS, JointCovariance, Solution, mount_blocks

# Relative rounding of an image coordinate. Computed coordinates are exact to about 1e-15, or to 1e-10 if
# errors of control strain their network; measured coordinates are exact to 1e-7 at best.
ROUNDING = 1e-9
MOTIONS = 7  # position, attitude and scale, which image points leave open
# Standard deviation of an image coordinate that no measurement surpasses: targets reach 1/100 px, computed
# images 1/1000 px. With larger weights, control and bars of a usual survey would vanish in rounding. Source:
# Luhmann et al. (2020), Close-Range Photogrammetry, sec. 5.4.2.
MIN_SIGMA_PX = 1e-3

Further = ParamSpec("Further")
Computed = TypeVar("Computed")


@dataclass(frozen=True)
class Covariance:
    """Marginal covariance of the unknowns in the datum of the adjustment, scaled by a posteriori sigma0^2."""

    points: FloatArray  # X, Y, Z of each object point, object unit^2, (n, 3, 3)
    exterior: FloatArray  # X0, Y0, Z0 (object unit) and omega, phi, kappa (rad), (m, 6, 6)
    # of the free parameters of each camera, in order; infinite variance if not determined, (f, f)
    interior: tuple[FloatArray, ...]
    points_limiting: FloatArray  # object points with cameras held fixed, object unit^2, (n, 3, 3)
    # joint, of `interior` of all cameras, then X, Y, Z (object unit), omega, phi, kappa (rad) of each camera
    # in its rig; empty without rigs, (s, s)
    rigs: FloatArray = field(default_factory=lambda: np.zeros((0, 0)))

    @property
    def mounts(self) -> FloatArray:
        """Covariance of X, Y, Z, omega, phi, kappa of each camera in its rig; 0 for references, (a, 6, 6)."""
        return mount_blocks(self.rigs, sum(map(len, self.interior)))


@dataclass(frozen=True)
class ErrorCorrelation:
    """Errors of image points, split into an independent part and a part common to neighbours in a photograph.

    The independent part has `alone` times the a posteriori variance of each image point. The common part
    moves neighbours by the same number of px, whatever their precision, in x and in y. At distance d, its
    covariance in one photograph is `common` exp(-d / length_px).
    """

    # variance of the independent part over the a posteriori variance of an observation of the same weight
    alone: float
    common: float  # variance of the common part over sigma0_px^2, that of a usual image point
    length_px: float  # distance at which the covariance of the common part has fallen to 1/e
    design_effect: float = 1.0  # by which the weights of these image points are divided, see `Source`

    def sigmas_px(self, sigma0_px: float) -> tuple[float, float]:
        """Return the standard deviations of the independent and the common part of an image coordinate, px.

        Args:
            sigma0_px: a posteriori standard deviation of a usual image coordinate, px.
        """
        return (self.alone * self.design_effect) ** 0.5 * sigma0_px, self.common**0.5 * sigma0_px


@dataclass(frozen=True)
class ObservedResiduals:
    """Residuals of the observations of one kind, other than image points, that took part in an adjustment."""

    index: int  # index of the kind in `Network.observations`
    rows: IntArray  # rows of the observations that took part, (n,)
    difference: FloatArray  # computed minus observed, (n, d)
    redundancy_numbers: FloatArray  # 0 to 1; NaN where a component was not observed, (n, d)
    standardised: FloatArray  # Baarda's w for sigma0 = 1; NaN where a component is not checked, (n, d)
    count: int  # number of scalar observations
    vPv: float
    redundancy: float  # total redundancy; NaN without covariance


class GroupParameters(NamedTuple):
    """Parameters that a group of observations determines, such as an additive constant or a probe tip."""

    group: str
    names: tuple[str, ...]  # (h,)
    value: FloatArray  # object unit, (h,)
    covariance: FloatArray  # infinite variances where not determined, (h, h)


@dataclass(frozen=True, repr=False)
class Adjustment:
    """Result of a least-squares adjustment of a network.

    Example:
        >>> import sfm
        >>> adjustment = sfm.adjust(result.network, result.estimate, reject="none")
        >>> adjustment.datum, adjustment.rejected.any(), adjustment.covariance.points.shape
        ('free', np.False_, (20, 3, 3))
    """

    network: Network  # network as given, including rejected image points
    estimate: Estimate  # adjusted interior and exterior orientation and points
    converged: bool  # whether the criterion of convergence was met
    iterations: int  # number of steps
    datum: str  # free | minimal | control
    defect: int  # rank defect of the normal equations without datum, determined numerically
    expected_defect: int  # defect that the datum is expected to fix
    undetermined: tuple[str, ...]  # parameters that cannot be determined, in words; empty if none
    residuals: FloatArray  # v = computed - measured, px, pixel frame, including rejected ones, (k, 2)
    rejected: BoolArray  # image points that took no part, (k,)
    redundancy_numbers: FloatArray  # one per image coordinate, 0 to 1; NaN where rejected, (k, 2)
    sigma_px: float  # a priori standard deviation of unit weight, px
    sigma0: float  # a posteriori over a priori standard deviation of unit weight, including `inflation`
    redundancy: int  # observations and constraints minus unknowns, less the discount
    unknowns: int  # number of adjusted parameters
    observations: int  # number of scalar observations used: image coordinates and other kinds
    covariance: Covariance
    # Baarda's w of each image coordinate, v over its a priori standard deviation; predicted for rejected
    # image points, (k, 2)
    standardised: FloatArray = field(default_factory=lambda: np.zeros((0, 2)))
    # diagonal of P Qvv P of each image point, with the cofactors Qvv of its residual; NaN where rejected,
    # px^-2, (k, 2)
    residual_weights: FloatArray = field(default_factory=lambda: np.zeros((0, 2)))
    # factor on the weight of each image point: 0 where rejected, between 0 and 1 by reweighting, else 1, (k,)
    weights: FloatArray = field(default_factory=lambda: np.zeros(0))
    # factor of an M-estimator on the standard deviations that follow from v'Pv with its weights, see
    # `robust.inflation`; 1 with least squares
    inflation: float = 1.0
    observed: tuple[ObservedResiduals, ...] = ()  # residuals of observations other than image points
    # factor on the stated standard deviations of each image point for its weight, (k,)
    image_sigma_factor: FloatArray = field(default_factory=lambda: np.ones(0))
    datum_points: BoolArray | None = None  # object points that carry the datum; all if None, (n,)
    unknown_counts: tuple[int, int, int] = (0, 0, 0)  # exterior orientation, interior orientation, points
    # probability that the applied test rejects a good image coordinate; Baarda's usual value without a test
    test_alpha: float = LEVEL
    false_alarm: float = FALSE_ALARM  # probability that the verdict calls a right result wrong
    start_sigma0: float = float("nan")  # sigma0 at the start values
    discount: int = 0  # by how much errors in common lower the redundancy, see `Network.share`
    remarks: tuple[Remark, ...] = ()  # remarks on parts of the robust test that could not be completed
    error_correlation: ErrorCorrelation | None = None  # correlation of neighbours included in the covariance
    independent: Covariance | None = None  # covariance without that correlation, None without correlation
    judge: Callable[[Adjustment], Verdict] | None = None  # judges it when its verdict is asked for
    joint: Callable[[Adjustment], JointCovariance] | None = None  # gives its joint covariances when asked

    @cached_property
    def verdict(self) -> Verdict | None:
        """Level, headline and all remarks; None if it was not judged."""
        return None if self.judge is None else self.judge(self)

    def __getstate__(self) -> dict[str, object]:
        """Return what is pickled: not the figures that are computed again when needed."""
        return {name: value for name, value in self.__dict__.items() if name != "_figures"}

    @cached_property
    def solution(self) -> Solution:
        """The accepted image points, with their solution and covariance."""
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
            joint=None if self.joint is None else self.joint(self),
            sigma0=self.sigma0 if self.sigma0 > 0 else 1.0,
            judged=partial(getattr, self, "verdict"),
        )

    @property
    def levels(self) -> Levels:
        """Levels of all tests of the adjustment."""
        return Levels(self.false_alarm)

    @property
    def group_parameters(self) -> tuple[GroupParameters, ...]:
        """Parameters of groups of observations that are results of a survey, with their covariance."""
        groups: list[GroupParameters] = []
        for group in self.network.observations:
            if isinstance(group, Group) and group.reported and len(group):
                fitted = group.own_parameters(values_of(self.estimate))
                J = fitted.J.reshape(len(fitted.J), -1)
                C = self.solution.covariance_of([self.network.points[j] for j in group.point])
                C = self.sigma0**2 * fitted.cofactor + J @ C @ J.T
                groups.append(GroupParameters(group.group, group.reported, fitted.value, C))
        return tuple(groups)

    @property
    def has_scale(self) -> bool:
        """Whether lengths are in the object unit: from given values, or by placement on control."""
        given = self.datum == "control" or self.expected_defect < MOTIONS or len(self.network.scale_bars) > 0
        return given or len(self.network.control.complete) >= 2

    @property
    def vPv(self) -> float:
        """Weighted sum of squared residuals of all observations, with a priori unit weight."""
        return (self.sigma0 / self.inflation) ** 2 * self.redundancy

    @property
    def cofactors(self) -> Covariance:
        """Covariance of independent errors for sigma0 = 1, as implied by the weights of the adjustment."""
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
        """Number of iterations, in words; start values of a survey are already adjusted."""
        return (
            counted(self.iterations, "iteration")
            if self.iterations
            else "0 further iterations after the orientation"
        )

    @property
    def tau(self) -> FloatArray:
        """Pope's tau of each image coordinate: Baarda's w over the a posteriori sigma0, (k, 2)."""
        return self.standardised / self.image_sigma0

    @property
    def image_sigma0(self) -> float:
        """Sigma0 from the image points alone, on which the stated precision of other kinds has no effect."""
        used, share = ~self.rejected, self.network.share
        r = float(np.nansum(share[:, None] * self.redundancy_numbers))
        if not r > 0:
            return self.sigma0
        v, P = self.residuals[used], np.linalg.inv(self.image_covariance[used])
        vPv = float((share * self.weights)[used] @ np.einsum("ka,kab,kb->k", v, P, v))
        return self.inflation * float(np.sqrt(vPv / r))

    @property
    def image_covariance(self) -> FloatArray:
        """Covariance used to weight image points: stated covariance times squared factor, px^2, (k, 2, 2)."""
        return scaled_covariance(self.network.image_points.covariance, self.image_sigma_factor)

    @property
    def weight_factor(self) -> float:
        """Factor on the stated standard deviations of the image points; the median if factors differ."""
        return float(np.median(self.image_sigma_factor))

    @property
    def sigma_of_sources(self) -> tuple[float, ...]:
        """Standard deviation of an accepted image coordinate of each source, median, px; NaN without any."""
        kept = [~self.rejected & (self.network.source == k) for k in range(len(self.network.sources))]
        return tuple(_median_sigma(self.image_covariance[rows]) for rows in kept)

    @property
    def sigma0_px(self) -> float:
        """A posteriori standard deviation of an accepted image coordinate, median, px."""
        return self.sigma0 * self.usual_px

    @property
    def usual_px(self) -> float:
        """A priori standard deviation of an accepted image coordinate, median, px."""
        return _median_sigma(self.image_covariance[~self.rejected])

    @property
    def stated_px(self) -> float:
        """Stated standard deviation of an accepted image coordinate, median, px."""
        return _median_sigma(self.network.image_points.covariance[~self.rejected])

    @property
    def rms_px(self) -> float:
        """Root mean square residual per coordinate of the accepted image points, px."""
        used = self.residuals[~self.rejected]
        return float((used**2).mean() ** 0.5)

    @property
    def is_exact(self) -> bool:
        """Whether the accepted residuals are mere rounding, as for image points without noise."""
        return bool(self.rms_px <= ROUNDING * np.abs(self.network.image_points.xy).max())

    @property
    def max_residual_px(self) -> float:
        """Longest residual vector among the accepted image points, px."""
        used = self.residuals[~self.rejected]
        return float((used**2).sum(axis=1).max() ** 0.5)

    def interior_sigma(self, camera: int) -> FloatArray:
        """Return the standard deviation of each parameter of a camera, (p,).

        It is NaN for parameters that were not adjusted, and infinite for parameters that are not determined.
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
        if self.verdict is not None:
            return [*rows, ("verdict", self.verdict.summary)]
        return rows + [("undetermined", name) for name in self.undetermined]

    def __repr__(self) -> str:
        return text_table("Adjustment", ("", ""), self._rows())

    def _repr_html_(self) -> str:
        return html_table("Adjustment", ("", ""), self._rows())


def computed_once(
    compute: Callable[Concatenate[Adjustment, Further], Computed],
) -> Callable[Concatenate[Adjustment, Further], Computed]:
    """Return a function of an adjustment that keeps what it returned, as a cached property does.

    Judgement and report ask for the same figures.
    """

    @wraps(compute)
    def figure(adjustment: Adjustment, /, *args: Further.args, **options: Further.kwargs) -> Computed:
        kept = adjustment.__dict__.setdefault("_figures", {})
        key = (f"{compute.__module__}.{compute.__name__}", args, *sorted(options.items()))
        if key not in kept:
            kept[key] = compute(adjustment, *args, **options)
        computed: Computed = kept[key]
        return computed

    return figure


def _median_sigma(covariance: FloatArray) -> float:
    """Return the median sigma of a coordinate, on which a few low weights have no effect; NaN if empty."""
    if not len(covariance):
        return float("nan")
    return float((np.median(np.trace(covariance, axis1=1, axis2=2)) / 2) ** 0.5)
