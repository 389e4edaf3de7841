"""Image points whose stated standard deviations are too small beside those of the others."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import sfm
from sfm.adjustment.datum import Datum
from sfm.judgement.stated_precision import stated_precision_remarks
from sfm.model.distributions import normal_ppf
from sfm.model.estimate import Estimate
from sfm.model.network import Network
from sfm.model.remarks.remark import of_kind
from sfm.model.similarity import fit_similarity
from sfm.pipeline import run_survey
from tests.surveys import survey_of
from tests.synthetic import make_network, observed_anew, seed_of


def stated(name: str, factor: float, *, points: int = 12, gross: float = 0.0) -> tuple[Network, Estimate]:
    """Return a network in which the standard deviations of some points are a factor too small."""
    rng = seed_of(name)
    network, truth = make_network(rng, images=8, points=32, free=("c",))
    network = observed_anew(network, truth, 0.1, rng)
    seen = network.image_points
    xy = seen.xy.copy()
    wrong = rng.random(len(xy)) < gross
    xy[wrong] += rng.normal(0.0, 20.0, (int(wrong.sum()), 2))
    sigma = np.where(seen.point < points, 0.1 / factor, 0.1)
    covariance = sigma[:, None, None] ** 2 * np.eye(2)
    return replace(network, image_points=replace(seen, xy=xy, covariance=covariance)), truth


@pytest.mark.sweep(0, 3)
@pytest.mark.parametrize(("factor", "severity"), [(10.0, ("error",)), (2.0, ("warning", "error"))])
@pytest.mark.parametrize("seed", range(2))
def test_points_stated_too_precise_are_named(factor: float, severity: tuple[str, ...], seed: int) -> None:
    network, truth = stated(f"too precise {factor} {seed}", factor)
    a = sfm.adjust(network, truth, datum=Datum("free"), reject="tau")
    result = run_survey(survey_of(network, truth, sigma=True, adjust={"reject": "tau"}))
    for remarks in (a.verdict.remarks, result.verdict.remarks):
        (said,) = [one for one in remarks if one.kind == "image_sigmas"]
        assert said.severity in severity and set(said.names("points")) == set(network.points[:12])
        assert 1.5 < said.number("factor") < 1.5 * factor
        assert said.number("stated") == pytest.approx(0.1 / factor)


@pytest.mark.parametrize(("factor", "points", "severity"), [(12.0, 12, "error"), (4.0, 16, "warning")])
def test_they_are_an_error_if_others_were_rejected_for_them(
    factor: float, points: int, severity: str
) -> None:
    """Half of the points too precise leave the others too few to contradict, and no coordinate is wrong."""
    network, truth = stated(f"half {factor}", factor, points=points)
    a = sfm.adjust(network, truth, datum=Datum("free"), reject="tau")
    (said,) = of_kind(a.verdict.remarks, "image_sigmas")
    assert said.severity == severity and said.number("factor") > 2
    error = fit_similarity(truth.points, a.estimate.points).apply(truth.points) - a.estimate.points
    worst = np.abs(error / np.sqrt(np.diagonal(a.covariance.points, axis1=1, axis2=2))).max()
    assert (worst > 5) == (severity == "error")


@pytest.mark.parametrize("gross", [0.0, 0.05])
@pytest.mark.parametrize("factor", [1.0, 1.02, 5.0])
def test_right_standard_deviations_are_not(factor: float, gross: float) -> None:
    """Also of points that are as much better as they are stated to be, and with gross errors among them."""
    network, truth = stated(f"right {factor} {gross}", factor, gross=gross)
    seen = network.image_points
    rng = seed_of("better")
    if factor == 5.0:
        better = np.linalg.cholesky(seen.covariance)
        exact = observed_anew(network, truth, 0.0, rng).image_points.xy
        xy = exact + np.einsum("kab,kb->ka", better, rng.standard_normal(seen.xy.shape))
        network = replace(network, image_points=replace(seen, xy=xy))
    a = sfm.adjust(network, truth, datum=Datum("free"), reject="tau")
    assert "image_sigmas" not in {one.kind for one in a.verdict.remarks}


@pytest.mark.parametrize(("points", "named"), [(1, False), (12, True)])
def test_few_image_points_that_scatter_more_may_do_so_by_chance(points: int, named: bool) -> None:
    network, truth = stated("by chance", 3.5, points=points)
    a = sfm.adjust(network, truth, datum=Datum("free"), reject="none")
    assert bool(of_kind(a.verdict.remarks, "image_sigmas")) == named


@pytest.mark.parametrize(("ratio", "points"), [(1.003, 16), (1.0095, 8)])
def test_standard_deviations_within_one_per_cent_are_one_class(ratio: float, points: int) -> None:
    """Two times eight points that scatter three times as much as stated, at almost the same value."""
    rng = seed_of("classes")
    network, truth = make_network(rng, images=8, points=32, free=("c",))
    xy, exact = (observed_anew(network, truth, noise, rng).image_points.xy for noise in (0.1, 0.0))
    seen = network.image_points
    worse = np.where(seen.point < 16, 3.0, 1.0)[:, None]
    least = np.exp(-2.3)  # px, the middle of a class
    sigma = np.select([seen.point < 8, seen.point < 16], [least, ratio * least], 0.12)
    covariance = sigma[:, None, None] ** 2 * np.eye(2)
    points_seen = replace(seen, xy=exact + worse * (xy - exact), covariance=covariance)
    a = sfm.adjust(replace(network, image_points=points_seen), truth, datum=Datum("free"), reject="none")
    (said,) = of_kind(a.verdict.remarks, "image_sigmas")
    assert len(said.names("points")) == points


@pytest.mark.parametrize("others", [0.3, 3.0])
@pytest.mark.parametrize(("ratio", "named"), [(1.4, False), (1.6, True)])
def test_classes_are_compared_by_their_ratio_whatever_sigma0_is(
    others: float, ratio: float, named: bool
) -> None:
    """A ratio below 1.5 changes no result, however surely it is known."""
    network, truth = stated("ratio of classes", 2.0, points=16)
    a = sfm.adjust(network, truth, datum=Datum("free"), reject="none")
    scale = np.where(network.image_points.point < 16, ratio, 1.0) * others
    rank = np.empty(len(scale))  # both classes have the quantiles of a normal distribution
    for few in (network.image_points.point < 16, network.image_points.point >= 16):
        rank[few] = (np.arange(few.sum()) + 0.5) / few.sum()
    w = scale[:, None] * normal_ppf(np.stack([rank, rank], axis=1))
    said = stated_precision_remarks(replace(a, standardised=np.tile(w, (1, 1))))
    assert len(said) == named
    if named:
        assert said[0].number("factor") == pytest.approx(ratio, rel=0.02)
