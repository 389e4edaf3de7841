"""Centroids and edge ellipses: unbiased, with true covariance, in the order of precision of theory."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from sfm.model.conventions import AnyArray, FloatArray
from sfm.model.errors import KolinearError
from sfm.targets.detect import CENTRES, find_targets
from sfm.targets.fits.centroid import measure_centroids, measure_edge_ellipses
from sfm.targets.measure import axes_from_shape, fit_ellipse_model, shape_from_axes

SUPER, SIZE, COUNT, NOISE = 5, 40, 14, 2.0


def picture(sign: int, seed: int) -> tuple[AnyArray, FloatArray, FloatArray, FloatArray]:
    """Return a photograph of COUNT^2 blurred ellipses and their centres, semi-axes and angles."""
    rng = np.random.default_rng(seed)
    n = COUNT**2
    axes = np.sort(rng.uniform(4, 10, (n, 2)), axis=1)[:, ::-1]
    angle = rng.uniform(-1.5, 1.5, n)
    inner = (SIZE - 1) / 2 + rng.uniform(-0.5, 0.5, (n, 2))
    photograph = np.empty((COUNT * SIZE, COUNT * SIZE))
    y, x = (np.mgrid[: SIZE * SUPER, : SIZE * SUPER] + 0.5) / SUPER - 0.5
    for k in range(n):
        c, s = np.cos(angle[k]), np.sin(angle[k])
        dx, dy = x - inner[k, 0], y - inner[k, 1]
        u, v = (c * dx + s * dy) / axes[k, 0], (c * dy - s * dx) / axes[k, 1]
        rho = np.hypot(u, v) + 1e-9
        distance = rho * (rho - 1) / (np.hypot(u / axes[k, 0], v / axes[k, 1]) + 1e-9)
        soft = cv2.GaussianBlur(np.clip(0.5 - distance * SUPER, 0, 1).astype(np.float32), (0, 0), 0.8 * SUPER)
        i, j = divmod(k, COUNT)
        block = cv2.resize(soft, (SIZE, SIZE), interpolation=cv2.INTER_AREA)
        photograph[i * SIZE : (i + 1) * SIZE, j * SIZE : (j + 1) * SIZE] = 120 + sign * 90 * block
    photograph += rng.normal(0, NOISE, photograph.shape)
    i, j = np.divmod(np.arange(n), COUNT)
    centre = inner + SIZE * np.column_stack([j, i])
    return np.round(photograph).clip(0, 255).astype(np.uint8), centre, axes, angle


@pytest.mark.parametrize("sign", [1, -1])
def test_every_mode_is_unbiased_and_knows_its_precision(sign: int) -> None:
    photograph, truth, axes, angle = picture(sign, 3)
    n = len(truth)
    shape = shape_from_axes(axes * 1.05, angle)
    start = truth + np.random.default_rng(4).normal(0, 0.2, truth.shape)
    signs = np.full(n, sign)
    found = {
        w: measure_centroids(photograph, start, shape, signs, noise=NOISE, weights=w)
        for w in ("binary", "intensity", "squared")
    }
    xy, covariance, edge_shape = measure_edge_ellipses(photograph, start, shape, signs, noise=NOISE)
    found["edges"] = xy, covariance
    fit = fit_ellipse_model(photograph, start, shape, signs, noise=NOISE)
    found["fit"] = fit.xy, fit.covariance
    rms, squared = {}, {}
    for mode, (xy, covariance) in found.items():
        error = xy - truth
        rms[mode] = np.sqrt((error**2).mean())
        squared[mode] = np.einsum("ki,kij,kj->k", error, np.linalg.inv(covariance), error).mean() / 2
        assert np.abs(error.mean(axis=0)).max() < 4 * rms[mode] / np.sqrt(n)
    # mean of 392 squared deviates, 1 +- 0.07; the binary centroid's error is no noise, the edges correlate
    assert squared["fit"] == pytest.approx(1.0, abs=0.25)
    assert squared["intensity"] == pytest.approx(1.0, abs=0.3)
    assert squared["squared"] == pytest.approx(1.0, abs=0.3)
    assert squared["edges"] == pytest.approx(1.0, abs=0.5)
    assert squared["binary"] == pytest.approx(1.0, abs=0.6)
    # measured on 24 megapixels: 1.0, 1.2, 1.5 and 11 times the Cramer-Rao bound
    assert rms["fit"] < rms["intensity"] < rms["squared"] < rms["binary"]
    assert rms["fit"] < rms["edges"] < rms["binary"]
    np.testing.assert_allclose(axes_from_shape(edge_shape)[0], axes, rtol=0.05)


def test_find_targets_measures_centres_in_every_mode() -> None:
    photograph, truth, *_ = picture(-1, 3)
    by_model = find_targets(photograph, polarity="dark")
    for centres in CENTRES:
        found = find_targets(photograph, polarity="dark", centres=centres)
        nearest = ((found.xy[:, None] - truth) ** 2).sum(axis=2).min(axis=1)
        assert len(found) == len(truth) and np.sqrt(nearest.max()) < 0.3
        assert np.isfinite(found.covariance).all()
        assert (centres == "model") == np.array_equal(found.xy, by_model.xy)
    with pytest.raises(KolinearError, match="centres 'spline', expected one of model, edges, binary"):
        find_targets(photograph, centres="spline")


def test_what_cannot_be_measured_is_nan() -> None:
    flat = np.full((60, 60), 80, np.uint8)
    xy, shape = np.array([[30.0, 30.0], [3.0, 30.0]]), shape_from_axes(np.full((2, 2), 6.0), np.zeros(2))
    for centre, covariance in (
        measure_centroids(flat, xy, shape, np.ones(2, int), noise=1.0),
        measure_edge_ellipses(flat, xy, shape, np.ones(2, int), noise=1.0)[:2],
    ):
        assert np.isnan(centre).all()
        assert np.isnan(covariance).all()
    with pytest.raises(KolinearError, match="'cubic', expected one of binary, intensity, squared"):
        measure_centroids(flat, xy, shape, np.ones(2, int), noise=1.0, weights="cubic")
