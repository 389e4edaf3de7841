"""Remarks on single cameras: how well c is known, where the principal point is, and the shape of pixels."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from sfm.adjustment.datum import Datum
from sfm.adjustment.result import Adjustment
from sfm.adjustment.solve import adjust
from sfm.judgement import cameras
from sfm.judgement.survey_result import SurveyResult
from sfm.model.remarks.remark import kinds_of
from tests.synthetic import make_network, seed_of


@pytest.fixture(scope="module")
def a() -> Adjustment:
    network, truth = make_network(
        seed_of("camera shares"), images=6, points=20, cameras=2, free=("c", "x0", "y0", "b1", "b2")
    )
    return adjust(network, truth, datum=Datum("free"), reject="none")


def result_of(a: Adjustment, **parts: Any) -> SurveyResult:
    return SurveyResult("shares", "m", 6, (), a, np.full(len(a.network.points), -1), None, **parts)


def with_sigma(a: Adjustment, camera: int, **sigma: float) -> Adjustment:
    """Return the adjustment with other standard deviations of interior parameters."""
    interior = [one.copy() for one in a.covariance.interior]
    free = np.flatnonzero(a.estimate.cameras[camera].free).tolist()
    names = [a.estimate.cameras[camera].names[s] for s in free]
    for name, one in sigma.items():
        place = (
            names.index(name)
            if len(interior[camera]) == len(free)
            else list(a.estimate.cameras[camera].names).index(name)
        )
        interior[camera][place, :] = interior[camera][:, place] = 0.0
        interior[camera][place, place] = one**2
    return replace(a, covariance=replace(a.covariance, interior=tuple(interior)))


@pytest.mark.parametrize(
    ("share", "severity"), [(0.04, ()), (0.06, ("warning",)), (0.19, ("warning",)), (0.21, ("error",))]
)
def test_c_that_the_photographs_hardly_determine(
    share: float, severity: tuple[str, ...], a: Adjustment
) -> None:
    """A warning where EXIF data say as much, an error where five standard deviations reach 0."""
    c = float(a.estimate.cameras[1].parameters[0])
    weak = with_sigma(a, 1, c=share * c)
    assert weak.interior_sigma(1)[0] == pytest.approx(share * c)
    partners = SimpleNamespace(parameter="c of camera camera 2", partners=("Z0",))
    found = cameras._poorly_determined(result_of(weak, orientation_correlations=(partners,)))
    assert tuple(one.severity for one in found) == severity
    for one in found:
        assert one.number("share") == pytest.approx(share) and one.names("camera") == ("camera 2",)
        assert one.names("partners") == ("Z0",)


def test_a_shared_c_is_told_once(a: Adjustment) -> None:
    group = tuple(replace(one, shared=("lens",) * len(one.names)) for one in a.estimate.cameras)
    one = replace(a, estimate=replace(a.estimate, cameras=group))
    c = float(group[0].parameters[0])
    for k in range(2):
        one = with_sigma(one, k, c=0.2 * c)
    (said,) = cameras._poorly_determined(result_of(one))
    assert said.names("camera") == (group[0].owner_of(0),)


def with_values(a: Adjustment, camera: int, **values: float) -> Adjustment:
    some = list(a.estimate.cameras)
    p = some[camera].parameters.copy()
    for name, value in values.items():
        p[some[camera].names.index(name)] = value
    some[camera] = some[camera].with_parameters(p)
    return replace(a, estimate=replace(a.estimate, cameras=tuple(some)))


@pytest.mark.parametrize(("value", "sigmas", "said"), [(0.02, 2.9, 0), (0.02, 3.1, 1), (-0.02, 3.1, 1)])
def test_pixels_are_judged_where_three_standard_deviations_exclude_square_ones(
    value: float, sigmas: float, said: int, a: Adjustment
) -> None:
    some = with_values(with_sigma(a, 1, b1=abs(value) / sigmas, b2=1.0), 1, b1=value, b2=0.02)
    found = [one for one in cameras._pixels(result_of(some)) if one.names("camera") == ("camera 2",)]
    assert [one.names("parameter") for one in found] == [("b1",)] * said
    for one in found:
        assert one.number("share") == pytest.approx(abs(value))


@pytest.mark.parametrize(("sigmas", "said"), [(2.9, 0), (3.1, 1)])
def test_the_ratio_of_focal_lengths_has_the_variance_of_both(sigmas: float, said: int) -> None:
    network, truth = make_network(seed_of("ratio"), images=6, points=20, model="opencv", free=("fx", "fy"))
    a = adjust(network, truth, datum=Datum("free"), reject="none")
    fx = a.estimate.cameras[0].value("fx")
    by = 0.05
    relative = by / sigmas / np.hypot(0.6, 0.8)
    some = with_values(a, 0, fy=fx * (1 + by))
    some = with_sigma(some, 0, fx=0.6 * relative * fx, fy=0.8 * relative * fx * (1 + by))
    found = cameras._pixels(result_of(some))
    assert [one.names("parameter") for one in found] == [("fy / fx - 1",)] * said
    for one in found:
        assert one.number("share") == pytest.approx(by)
    narrow = replace(some.estimate.cameras[0], pixel_mm=np.array([1.0, 1.0 / (1 + by)]))
    square = replace(some, estimate=replace(some.estimate, cameras=(narrow,)))
    assert cameras._pixels(result_of(square)) == ()


@pytest.mark.parametrize(("share", "kinds"), [(0.09, ()), (0.11, ("principal_point_far",))])
def test_a_principal_point_is_far_beyond_a_tenth_of_the_diagonal(
    share: float, kinds: tuple[str, ...], a: Adjustment
) -> None:
    """In pixels and mm; only one that was adjusted, by its larger standard deviation."""
    diagonal_mm = np.hypot(2000, 1500) * 0.005
    some = with_values(a, 1, x0=share * 0.6 * diagonal_mm, y0=share * 0.8 * diagonal_mm)
    some = with_sigma(some, 1, x0=0.001 * diagonal_mm, y0=0.002 * diagonal_mm)
    found = cameras._principal_points(result_of(some))
    assert kinds_of(found) == kinds
    for one in found:
        assert one.number("share") == pytest.approx(share, rel=0.01)
        assert one.number("sigma") == pytest.approx(0.002, rel=0.01)
        assert one.number("surely") == pytest.approx(share - 3 * 0.002, rel=0.02)
    held = tuple(replace(one, free=np.zeros_like(one.free)) for one in some.estimate.cameras)
    some = replace(some, estimate=replace(some.estimate, cameras=held))
    assert cameras._principal_points(result_of(some)) == ()


@pytest.mark.parametrize(
    ("at", "size"),
    [
        ((750.0, 1000.0), (1500, 2000)),
        ((500.0, 375.0), (1000, 750)),
        ((2000.0, 1500.0), (4000, 3000)),
        ((1000.0, 750.0), None),
        ((600.0, 500.0), None),
    ],
)
def test_the_format_around_a_principal_point(at: tuple[float, float], size: tuple[int, int] | None) -> None:
    assert cameras._format_around(np.array(at), 2000, 1500) == size
