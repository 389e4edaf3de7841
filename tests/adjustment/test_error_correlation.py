"""Errors that neighbouring image points have in common: found in residuals, and in the covariance."""

from __future__ import annotations

import tracemalloc
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.distance import cdist

from sfm.adjustment.covariance import change_datum, marginal_of, with_error_correlation
from sfm.adjustment.engine import correlated
from sfm.adjustment.engine.correlated import correlated_sum, largest_factor
from sfm.adjustment.quality.correlations import (
    design_effect_of_neighbours,
    estimate_error_correlation,
    with_neighbours,
)
from sfm.adjustment.result import Adjustment, ErrorCorrelation
from sfm.adjustment.solve import AdjustmentOptions, adjust
from sfm.judgement.hypotheses.columns import columns_of
from sfm.judgement.hypotheses.families import MOVED, Alternative
from sfm.judgement.hypotheses.hypotheses import judge_alternatives
from sfm.judgement.hypotheses.score import Reduced, gain_of, reduce_adjustment
from sfm.model.conventions import FloatArray
from sfm.model.estimate import Estimate
from sfm.model.network import Network, Source, rows_of
from sfm.model.similarity import fit_similarity
from sfm.report.phrases import describe_neighbours, significant
from sfm.survey.adjusting.choices import solve_survey
from sfm.survey.inputs.settings import AdjustSettings
from sfm.survey.inputs.sources import TEXTURE
from sfm.survey.sources import joined
from sfm.survey.sources.source import Correspondences
from tests.surveys import survey_of
from tests.synthetic import make_network, observed_anew, seed_of

SIGMA_PX = 0.1
TARGETS = 60  # points of these tests that are targets; the others are texture
PARTS = slice(0, TARGETS), slice(TARGETS, None)


def in_common(network: Network, share: float, length_px: float, rng: np.random.Generator) -> FloatArray:
    """Return errors, px, in common to neighbours with a share of the variance of a usual image point.

    Their covariance falls as exp(-d / length) with the distance; each point has the rest of its own alone.
    """
    seen = network.image_points
    factor = np.linalg.cholesky(seen.covariance)
    errors = np.sqrt(1 - share) * (factor @ rng.standard_normal((len(seen), 2, 1)))[:, :, 0]
    for rows in rows_of(seen.image, len(network.images)):
        covariance = np.exp(-cdist(seen.xy[rows], seen.xy[rows]) / length_px)
        factor = np.linalg.cholesky(covariance + 1e-9 * np.eye(len(rows)))
        errors[rows] += SIGMA_PX * np.sqrt(share) * factor @ rng.standard_normal((len(rows), 2))
    return errors


def adjusted(network: Network, truth: Estimate, errors: FloatArray) -> Adjustment:
    """Return the adjustment of the image points with other errors."""
    seen = network.image_points
    moved = replace(network, image_points=replace(seen, xy=seen.xy + errors))
    return adjust(moved, truth, reject="none", options=AdjustmentOptions(redundancy_numbers=False))


@pytest.fixture(scope="module")
def scene() -> tuple[Network, Estimate]:
    """Return a network without errors, many points on a plane in each of its photographs, and its truth."""
    return make_network(
        seed_of("common errors"), images=8, points=400, planar=True, free=("c",), noise_px=0.0
    )


@pytest.fixture(scope="module")
def unequal(scene: tuple[Network, Estimate]) -> tuple[Network, Estimate]:
    """Return the same where texture measures points, and x and y of each, with different precision."""
    network, truth = scene
    seen, rng = network.image_points, seed_of("unequal")
    k = len(seen)
    turned = np.linalg.qr(rng.standard_normal((k, 2, 2)))[0]
    sigma = SIGMA_PX * np.exp(rng.normal(0.0, 0.9, (k, 1)) + rng.normal(0.0, 0.3, (k, 2)))
    covariance = (turned * sigma[:, None] ** 2) @ np.swapaxes(turned, 1, 2)
    usual = np.median(np.trace(covariance, axis1=1, axis2=2)) / 2
    covariance *= SIGMA_PX**2 / usual
    return replace(network, image_points=replace(seen, covariance=covariance)), truth


@pytest.mark.sweep(1)
@pytest.mark.parametrize("name", ["scene", "unequal"])
def test_covariance_may_correlate_is_what_repetition_shows(request: pytest.FixtureRequest, name: str) -> None:
    """Of centres, points and c; the covariance of independent errors states centres far too precise.

    Neighbours are moved alike, also where one is much more precise than the other.
    """
    network, truth = request.getfixturevalue(name)
    correlation = ErrorCorrelation(alone=0.7, common=0.3, length_px=400.0)
    rng = seed_of("repeated")
    runs = [adjusted(network, truth, in_common(network, 0.3, 400.0, rng)) for _ in range(40)]
    of_unit_weight = replace(runs[0], sigma0=1.0)  # of the errors as they were drawn
    found = with_error_correlation(of_unit_weight, correlation)
    centres = np.var([one.estimate.position for one in runs], axis=0).mean()
    points = np.var([one.estimate.points for one in runs], axis=0).mean()
    c = np.var([one.estimate.cameras[0].parameters[0] for one in runs])
    ratios = np.sqrt(
        [
            centres / np.einsum("mii->mi", found.covariance.exterior)[:, :3].mean(),
            points / np.einsum("nii->ni", found.covariance.points).mean(),
            c / found.covariance.interior[0][0, 0],
        ]
    )
    assert ratios == pytest.approx(1.0, abs=0.25)
    independent = np.einsum("mii->mi", found.cofactors.exterior)[:, :3].mean()
    assert np.sqrt(centres / independent) > 1.6


@pytest.fixture(scope="module")
def in_few(unequal: tuple[Network, Estimate]) -> tuple[Network, Estimate]:
    """Return the same where each point is in three neighbouring photographs only."""
    network, truth = unequal
    seen, m = network.image_points, len(network.images)
    few = (seen.image - seen.point * m // len(network.points)) % m < 3
    return replace(network, image_points=seen.select(few)), truth


@pytest.mark.parametrize("name", ["unequal", "in_few"])
@pytest.mark.parametrize("datum", ["free", "minimal"])
def test_every_covariance_has_the_common_errors(
    request: pytest.FixtureRequest, datum: str, name: str
) -> None:
    """Marginal and joint ones, also after a change of datum; without common errors nothing is added."""
    network, truth = request.getfixturevalue(name)
    plain = adjusted(network, truth, in_common(network, 0.0, 1.0, seed_of("joint")))
    found = with_error_correlation(plain, ErrorCorrelation(alone=0.8, common=0.2, length_px=200.0))
    found, plain = change_datum(found, datum), change_datum(plain, datum)
    m, points = marginal_of(found), np.array([7, 3, 200])
    joint = m.joint(np.arange(12), points)
    assert joint[:3, :3] == pytest.approx(found.covariance.exterior[0, :3, :3], rel=1e-6)
    for k, j in enumerate(points):
        own = slice(12 + 3 * k, 15 + 3 * k)
        assert joint[own, own] == pytest.approx(found.covariance.points[j], rel=1e-6, abs=1e-14)
    Z = m.influence.of(np.arange(12), points)  # with independent errors it gives the usual covariance
    o, relative = m.layout.observations, found.usual_px * m.influence.linear.whitening
    correlation = found.error_correlation
    assert correlation is not None
    whole = correlated_sum(o.image, o.xy, relative, Z, correlation, np.ones(len(o.image), dtype=bool))
    whole += np.tensordot(Z, Z, axes=((0, 1), (0, 1)))
    scale = np.sqrt(np.outer(np.diagonal(joint), np.diagonal(joint)))
    assert joint / scale == pytest.approx(found.sigma0**2 * whole / scale, abs=1e-6)
    usual = marginal_of(plain).joint(np.arange(12), points)
    sigma = np.sqrt(np.diagonal(usual))
    assert plain.sigma0**2 * np.einsum("kcu,kcv->uv", Z, Z) / np.outer(sigma, sigma) == pytest.approx(
        usual / np.outer(sigma, sigma), abs=1e-6
    )
    assert found.cofactors.points == pytest.approx(plain.cofactors.points, rel=1e-9, abs=1e-15)
    none = with_error_correlation(plain, ErrorCorrelation(alone=1.0, common=0.0, length_px=200.0))
    assert none.covariance.points == pytest.approx(plain.covariance.points, rel=1e-9, abs=1e-15)


@pytest.mark.parametrize("pairs_per_cell", [0.0, np.inf])
@pytest.mark.parametrize("length_px", [20.0, 200.0])
def test_no_function_of_errors_varies_more_than_the_bound(
    unequal: tuple[Network, Estimate],
    length_px: float,
    pairs_per_cell: float,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The bound is above the largest eigenvalue of R, by less than twice what common errors add to it."""
    monkeypatch.setattr(correlated, "PAIRS_PER_CELL", pairs_per_cell)  # by cells, or exact sums
    network, truth = unequal
    a = adjusted(network, truth, in_common(network, 0.0, 1.0, seed_of("bound")))
    m, correlation = marginal_of(a), ErrorCorrelation(alone=0.9, common=0.1, length_px=length_px)
    o, relative = m.layout.observations, a.usual_px * m.influence.linear.whitening
    every, largest = np.ones(len(o.image), dtype=bool), 0.0
    for rows in rows_of(o.image, len(network.images)):
        C = 0.1 * np.exp(-cdist(o.xy[rows], o.xy[rows]) / length_px)
        R = np.einsum("aij,ab,bkj->aibk", relative[rows], C, relative[rows]).reshape(2 * len(rows), -1)
        largest = max(largest, float(np.linalg.eigvalsh(R + 0.9 * np.eye(len(R)))[-1]))
    bound = largest_factor(o, relative, correlation, every, np.inf)
    assert largest <= bound < largest + 2.0 * (largest - 0.9)
    assert largest_factor(o, relative, correlation, every, largest - 0.01) == np.inf


def test_errors_hardly_in_common_widen_every_covariance_a_little(scene: tuple[Network, Estimate]) -> None:
    """No standard deviation is smaller than the exact one, and none larger by more than 10 %."""
    network, truth = scene
    plain = adjusted(network, truth, in_common(network, 0.0, 1.0, seed_of("hardly")))
    correlation = ErrorCorrelation(alone=0.999, common=0.002, length_px=20.0)
    found = with_error_correlation(plain, correlation)
    m, points = marginal_of(found), np.array([7, 3, 200])
    assert m.correlated is None and 1.0 < m.variance_factor <= 1.1**2
    Z = m.influence.of(np.arange(12), points)
    o, relative = m.layout.observations, found.usual_px * m.influence.linear.whitening
    exact = correlated_sum(o.image, o.xy, relative, Z, correlation, np.ones(len(o.image), dtype=bool))
    exact += np.tensordot(Z, Z, axes=((0, 1), (0, 1)))
    ratio = np.diagonal(m.joint(np.arange(12), points)) / (found.sigma0**2 * np.diagonal(exact))
    assert ratio.min() >= 1 - 1e-9 and ratio.max() <= 1.1**2
    assert found.covariance.points[7] == pytest.approx(m.joint(np.zeros(0, dtype=int), points[:1]), rel=1e-6)
    assert found.covariance.exterior == pytest.approx(m.variance_factor * plain.covariance.exterior, rel=1e-9)
    assert found.cofactors.points == pytest.approx(plain.cofactors.points, rel=1e-9)


def test_common_errors_take_little_memory() -> None:
    """Neither all image points by all unknowns nor all by all of a photograph: these took 7 kB each."""
    network, truth = make_network(seed_of("memory"), images=12, points=500, planar=True, noise_px=0.3)
    a = adjust(network, truth, reject="none", options=AdjustmentOptions(redundancy_numbers=False))
    tracemalloc.start()
    a = with_error_correlation(a, ErrorCorrelation(alone=0.8, common=0.2, length_px=200.0))
    peak = tracemalloc.get_traced_memory()[1]
    solution, before = a.solution, tracemalloc.get_traced_memory()[0]
    tracemalloc.reset_peak()
    found = solution.with_joint_covariance.covariance
    kept, peak_of_joint = (number - before for number in tracemalloc.get_traced_memory())
    tracemalloc.stop()
    assert peak < 3000 * len(network.image_points)
    assert found is not None and kept < 1.2 * found.nbytes  # and no normal equations
    assert peak_of_joint < 8 * found.nbytes


def sigma_of_centres(adjustment: Adjustment) -> float:
    """Return the RMS standard deviation of the projection centres."""
    return float(np.sqrt(np.einsum("mii->mi", adjustment.covariance.exterior)[:, :3].mean()))


@pytest.mark.sweep(0, 3)
@pytest.mark.parametrize(
    ("name", "share", "length_px"),
    [("scene", 0.3, 400.0), ("scene", 0.3, 100.0), ("scene", 0.1, 400.0), ("unequal", 0.3, 400.0)],
)
def test_common_errors_are_found(
    request: pytest.FixtureRequest, name: str, share: float, length_px: float
) -> None:
    """Centres are as precise as stated, though points, orientations and c take much of long waves."""
    network, truth = request.getfixturevalue(name)
    ratios, plain = [], []
    for seed in range(6):
        a = adjusted(network, truth, in_common(network, share, length_px, seed_of(f"common {seed}")))
        found = estimate_error_correlation(a)
        assert found is not None
        true = ErrorCorrelation(1 - share, share, length_px)
        expected = sigma_of_centres(with_error_correlation(replace(a, sigma0=1.0), true))
        ratios.append(sigma_of_centres(with_error_correlation(a, found)) / expected)
        plain.append(sigma_of_centres(a) / expected)
    assert np.mean(ratios) == pytest.approx(1.0, abs=0.15)
    assert min(ratios) > 0.6 and max(ratios) < 1.6
    assert max(plain) < 0.65


def test_independent_errors_have_little_in_common(scene: tuple[Network, Estimate]) -> None:
    """Chance alone makes standard deviations hardly larger."""
    network, truth = scene
    for seed in range(6):
        errors = in_common(network, 0.0, 1.0, seed_of(f"independent {seed}"))
        a = adjusted(network, truth, errors)
        found = estimate_error_correlation(a)
        if found is not None:
            assert sigma_of_centres(with_error_correlation(a, found)) < 1.25 * sigma_of_centres(a)


def test_surveys_of_texture_have_common_errors_in_their_covariance(scene: tuple[Network, Estimate]) -> None:
    """And in the words and figures of their results; targets are measured each by itself."""
    network, truth = scene
    seen = network.image_points
    moved = seen.xy + in_common(network, 0.3, 400.0, seed_of("texture"))
    network = replace(network, image_points=replace(seen, xy=moved))
    survey = survey_of(network, truth)
    matched = Correspondences(network, truth, np.full(len(network.points), 3))
    of_targets = solve_survey(survey, matched).adjustment
    textured = solve_survey(
        survey, replace(matched, network=replace(matched.network, sources=(TEXTURE,)))
    ).adjustment
    assert of_targets.error_correlation is None and describe_neighbours(of_targets) == ""
    assert textured.error_correlation is not None
    assert sigma_of_centres(textured) > 1.5 * sigma_of_centres(of_targets)
    alone, common = textured.error_correlation.sigmas_px(textured.sigma0_px)
    assert alone == pytest.approx(SIGMA_PX * np.sqrt(0.7), rel=0.2)
    assert f"{significant(common)} px in common" in describe_neighbours(textured)


@pytest.mark.parametrize("length_px", [pytest.param(150.0, marks=pytest.mark.slow), 300.0])
def test_common_errors_are_no_cause(scene: tuple[Network, Estimate], length_px: float) -> None:
    """Taken as independent, they look like a held parameter that is wrong, or like another camera."""
    network, truth = scene
    a = adjusted(network, truth, in_common(network, 0.95, length_px, seed_of("no cause 3")))
    assert judge_alternatives(a).causes
    assert judge_alternatives(with_neighbours(a)).causes == ()


@pytest.mark.slow
def test_points_that_moved_are_named_beside_common_errors(scene: tuple[Network, Estimate]) -> None:
    network, truth = scene
    seen, some = network.image_points, (5, 10, 20, 30, 40, 50, 80, 120, 200, 300)
    errors = in_common(network, 0.6, 300.0, seed_of("a cause"))
    errors[(seen.image >= 4) & np.isin(seen.point, some)] += (4.5 * SIGMA_PX, 0.0)
    a = adjusted(network, truth, errors)
    (cause,) = judge_alternatives(with_neighbours(a)).causes
    assert cause.kind == "points_moved"
    assert set(cause.names("points")) <= {network.points[j] for j in some}
    assert judge_alternatives(a).causes[0].kind == "held_parameter"  # errors taken as independent


@pytest.mark.slow
@pytest.mark.parametrize(("name", "share"), [("scene", 0.6), ("unequal", 0.3)])
def test_the_design_effect_is_by_how_much_common_errors_multiply_a_gain(
    request: pytest.FixtureRequest, name: str, share: float
) -> None:
    """The mean of gains by chance, of a held parameter over the whole format, is what it says."""
    network, truth = request.getfixturevalue(name)
    correlation = ErrorCorrelation(alone=1 - share, common=share, length_px=300.0)
    rng, gains, effect = seed_of("design effect"), [], 0.0
    for _ in range(60):
        a = adjusted(network, truth, in_common(network, share, 300.0, rng))
        columns = columns_of(a)
        a = replace(a, sigma0=1.0, error_correlation=correlation)
        reduced = reduce_adjustment(a)
        D = reduced.whiten(columns.freedoms[:, :, [3]])  # K1
        gains.append(_gain(reduced, D))
        effect = reduced.design_effect(D)
    assert effect > 5
    assert np.mean(gains) == pytest.approx(effect, rel=4 * np.sqrt(2 / len(gains)))
    alone = replace(reduced, adjustment=replace(a, error_correlation=None))
    assert alone.design_effect(D) == 1.0


@pytest.mark.slow
def test_neighbours_with_one_error_show_it_many_times(scene: tuple[Network, Estimate]) -> None:
    """The gain of a set of points, each of which may move by itself, spreads as the design effect says."""
    network, truth = scene
    near = np.argsort(np.linalg.norm(truth.points - truth.points[7], axis=1))[:10]
    after = (np.arange(len(network.images)) >= 4).astype(float)
    moved = Alternative(MOVED, "split", after, points=near)
    correlation = ErrorCorrelation(alone=0.05, common=0.95, length_px=300.0)
    rng, gains = seed_of("neighbours"), []
    for _ in range(60):
        a = adjusted(network, truth, in_common(network, 0.95, 300.0, rng))
        reduced = reduce_adjustment(replace(a, sigma0=1.0, error_correlation=correlation))
        D = moved.whitened(reduced)
        gains.append(gain_of(*reduced.project(D)).value)
    effect = reduced.design_effect(D)
    assert effect > 1.4 * np.mean(gains) / D.shape[2]  # the mean alone says less
    assert np.var(gains) / (2 * np.mean(gains)) == pytest.approx(effect, rel=0.5)


def of_two_sources(network: Network, common: FloatArray, rng: np.random.Generator) -> tuple[Network, Network]:
    """Return a network of 60 precise targets and of texture with errors in common; the targets alone."""
    seen = network.image_points
    targets = seen.point < TARGETS
    precise = SIGMA_PX / 3
    covariance = np.where(targets[:, None, None], precise**2 * np.eye(2), seen.covariance)
    xy = seen.xy + np.where(targets[:, None], precise * rng.standard_normal(seen.xy.shape), common)
    seen = replace(seen, xy=xy, covariance=covariance, source=(~targets).astype(np.int64))
    both = replace(network, image_points=seen, sources=(Source("targets"), TEXTURE))
    alone = replace(both, image_points=seen.select(targets))
    return both, replace(alone, points=alone.points[:TARGETS])


def with_design_effect(network: Network, effect: float) -> Network:
    targets, texture = network.sources
    return replace(network, sources=(targets, replace(texture, design_effect=effect)))


def off(a: Adjustment, truth: Estimate, points: slice) -> FloatArray:
    """Return errors of coordinates in the datum of all points, over their standard deviations, (n, 3)."""
    X, n = a.estimate.points, len(a.network.points)
    moved = fit_similarity(X, truth.points[:n]).apply(X) - truth.points[:n]
    return np.asarray((moved / np.sqrt(np.diagonal(a.covariance.points, axis1=1, axis2=2)))[points])


def test_texture_with_errors_in_common_does_not_outvote_targets(scene: tuple[Network, Estimate]) -> None:
    network, truth = scene
    start = replace(truth, points=truth.points[:TARGETS])
    c, over_sigma = [], []
    for seed in range(6):
        rng = seed_of(f"outvoted {seed}")
        both, alone = of_two_sources(network, in_common(network, 0.7, 400.0, rng), rng)
        plain = adjust(both, truth, reject="none")
        effect = design_effect_of_neighbours(plain)
        weighed = adjust(with_design_effect(both, effect), truth, reject="none")
        assert effect > 5 and 0.7 < weighed.sigma0 < 1.4 and weighed.discount > 0
        assert weighed.redundancy + weighed.discount == plain.redundancy
        correlated = with_neighbours(weighed)
        found = correlated.error_correlation
        assert found is not None
        assert found.sigmas_px(weighed.sigma0_px)[0] == pytest.approx(SIGMA_PX * 0.3**0.5, rel=0.3)
        over_sigma.append([(off(correlated, truth, part) ** 2).mean() for part in PARTS])
        targets = adjust(alone, start, reject="none")
        c.append([one.estimate.cameras[0].parameters[0] for one in (targets, plain, weighed)])
    of_targets, of_plain, of_weighed = np.sqrt(
        ((np.array(c) - truth.cameras[0].parameters[0]) ** 2).mean(axis=0)
    )
    assert of_weighed < 0.7 * of_plain and of_weighed < 1.1 * of_targets
    assert (np.abs(np.sqrt(np.mean(over_sigma, axis=0)) - 1) < 0.2).all()


@pytest.mark.parametrize("reject", ["tau", "huber", "tukey"])
def test_sigma0_counts_image_points_with_errors_in_common_in_part(
    scene: tuple[Network, Estimate], reject: str
) -> None:
    """With an effect of 400 and 4 targets in 3 photographs a redundancy by counts was negative."""
    network, truth = scene
    rng = seed_of("counted in part")
    both, _ = of_two_sources(network, in_common(network, 0.0, 400.0, rng), rng)
    seen = both.image_points
    few = replace(both, image_points=seen.select((seen.source == 1) | ((seen.point < 4) & (seen.image < 3))))
    for some, effect in ((both, 50.0), (few, 400.0)):
        a = adjust(with_design_effect(some, effect), truth, reject=reject)
        plain = adjust(some, truth, reject=reject)
        assert a.redundancy > 0 and a.sigma0 == pytest.approx(a.image_sigma0, rel=0.1)
        assert a.sigma0 == pytest.approx(plain.sigma0, rel=0.25)
        assert a.inflation == pytest.approx(plain.inflation, rel=0.15)
        assert a.redundancy + a.discount == plain.redundancy + plain.discount


def test_texture_that_fits_nothing_has_no_design_effect(scene: tuple[Network, Estimate]) -> None:
    network, truth = scene
    rng = seed_of("fits nothing")
    both, _ = of_two_sources(network, in_common(network, 0.5, 400.0, rng), rng)
    seen = both.image_points
    xy = seen.xy.copy()
    xy[seen.source == 1] = rng.permutation(xy[seen.source == 1])
    wrong = replace(both, image_points=replace(seen, xy=xy))
    start = replace(
        truth, points=np.where(np.arange(len(truth.points))[:, None] < TARGETS, truth.points, np.nan)
    )
    needed = np.full(len(wrong.points), 3)
    found = joined._balanced(wrong, start, needed, AdjustSettings())
    assert [source.design_effect for source in found.sources] == [1.0, 1.0]
    solved = solve_survey(survey_of(wrong, truth), Correspondences(wrong, start, needed)).adjustment
    assert solved.sigma0 == pytest.approx(1.0, rel=0.2) and set(solved.network.source) == {0}


def test_sources_without_errors_in_common_keep_their_weights(scene: tuple[Network, Estimate]) -> None:
    network, truth = scene
    rng = seed_of("independent sources")
    both, _ = of_two_sources(network, in_common(network, 0.0, 400.0, rng), rng)
    assert design_effect_of_neighbours(adjust(both, truth, reject="none")) < 2


def _gain(reduced: Reduced, D: FloatArray) -> float:
    H, g, _ = reduced.project(D)
    return float(g[0] ** 2 / H[0, 0])


def test_given_coordinates_are_judged_may_correlate(scene: tuple[Network, Estimate]) -> None:
    """True ones are confirmed by texture; taken as independent its errors contradict them."""
    network, truth = scene
    seen, some = network.image_points, np.arange(0, len(network.points), 5)
    moved = seen.xy + in_common(network, 0.95, 600.0, seed_of("given 0"))
    network = replace(network, image_points=replace(seen, xy=moved))
    network = network.with_control([network.points[j] for j in some], truth.points[some], 1e-5)
    survey = survey_of(network, truth)
    matched = Correspondences(network, truth, np.full(len(network.points), 3))
    of_targets, *_ = solve_survey(survey, matched).given_tests
    textured, *_ = solve_survey(
        survey, replace(matched, network=replace(matched.network, sources=(TEXTURE,)))
    ).given_tests
    assert of_targets.what == textured.what == "control"
    assert of_targets.probability < 0.01 and textured.probability > 0.1
    assert textured.statistic == pytest.approx(textured.dof, rel=0.15)


def test_control_leaves_no_datum_to_common_errors(scene: tuple[Network, Estimate]) -> None:
    network, truth = scene
    names = network.points[:6]
    noisy = observed_anew(network, truth, 0.1, seed_of("control and common errors"))
    controlled = noisy.with_control(names, truth.points[:6], 1e-4)
    a = adjust(controlled, truth, datum="control")
    none = with_error_correlation(a, ErrorCorrelation(alone=1.0, common=0.0, length_px=200.0))
    scale = np.abs(a.covariance.points).max()
    np.testing.assert_allclose(none.covariance.points, a.covariance.points, atol=1e-6 * scale)
    found = with_error_correlation(a, ErrorCorrelation(alone=0.8, common=0.2, length_px=200.0))
    assert (np.linalg.eigvalsh(found.covariance.points) > 0).all()
    assert not np.allclose(found.covariance.points, a.covariance.points, rtol=0.005, atol=0)
