"""Normal equations of photographs and cameras, from which alternatives are judged."""

from __future__ import annotations

import tracemalloc

import numpy as np

from sfm.judgement.hypotheses.score import _camera_normals
from tests.synthetic import seed_of


def test_normal_equations_of_cameras_are_those_of_their_image_points() -> None:
    """Photographs own six unknowns, interior parameters belong to all; one photograph has no image points."""
    rng = seed_of("normals of cameras")
    m, inner, image = 5, 7, np.array([0, 3, 1, 0, 4, 4, 1, 3, 0])
    A, v = rng.standard_normal((len(image), 2, 6 + inner)), rng.standard_normal((len(image), 2))
    size = 6 * m + inner
    J = np.zeros((len(image), 2, size))
    for k, i in enumerate(image):
        J[k, :, 6 * i : 6 * i + 6], J[k, :, 6 * m :] = A[k, :, :6], A[k, :, 6:]
    J = J.reshape(-1, size)
    S, t = _camera_normals(A, image, v, m, size)
    np.testing.assert_allclose(S, J.T @ J, atol=1e-12)
    np.testing.assert_allclose(t, J.T @ v.ravel(), atol=1e-12)


def test_a_camera_for_each_photograph_needs_no_more_memory_than_its_observations() -> None:
    """300 parameters of 60 cameras: a matrix for each image point would take 3 GB."""
    rng = seed_of("many cameras")
    m, inner, k = 60, 300, 4000
    A, v = rng.standard_normal((k, 2, 6 + inner)), rng.standard_normal((k, 2))
    tracemalloc.start()
    try:
        _camera_normals(A, np.sort(rng.integers(m, size=k)), v, m, 6 * m + inner)
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert peak < 2 * A.nbytes
