"""Resection by least squares: documents 003 and the textbook example, Jacobian, dispersion."""

import numpy as np
import pytest

from sfm.model.conventions import angles_from_rotation, rotation_from_angles, rotation_from_vector
from sfm.model.errors import GeometryError
from sfm.orientation.resection.least_squares import pose_normals, resect_least_squares
from tests.places import ROOT, SHARED
from tests.synthetic import seed_of

LAB2 = ROOT / "datasets/lab2"
SHARED = SHARED / "data/resection"
# datasets/lab2/README.md: image, points, X0 Y0 Z0 (m), omega phi kappa (deg), sigma0^2 (mm^2), as printed
TRUTH = [
    (9, 25, (1.8896867, 3.0358662, 3.7350004), (-19.1841784, -4.3449776, 2.0501490), 9.358634e-5, 2.167e-4),
    (10, 24, (1.6804833, 2.1658782, 3.5085583), (-0.4149385, -4.9369395, 92.4769822), 1.796144e-5, 4.191e-5),
    (
        14,
        19,
        (1.0095213, 2.5331665, 2.8063507),
        (-8.9397591, -17.0517497, 91.1811604),
        2.930867e-5,
        7.2144e-5,
    ),
    (18, 25, (2.1016108, 1.1946515, 3.6995847), (13.3667930, 1.4654585, 90.2308179), 5.900370e-5, 1.3664e-4),
]
# document 003, "SD for EOPs": m, and rad although the heading says deg; with the divisor n - 6
PRINTED_SD = {
    9: (9.8035e-03, 8.8936e-03, 3.9152e-03, 2.1493e-03, 2.2192e-03, 9.0243e-04),
    10: (3.6917e-03, 3.6434e-03, 1.1079e-03, 9.0229e-04, 9.1565e-04, 3.0840e-04),
    14: (3.8604e-03, 3.7749e-03, 2.7233e-03, 1.1152e-03, 1.2504e-03, 5.4805e-04),
    18: (7.2693e-03, 7.0928e-03, 2.5152e-03, 1.6975e-03, 1.6901e-03, 6.4748e-04),
}
# document 003, "EOPs over iterations", position after the first step (that of image 18 is not its own)
FIRST_STEP = {9: (1.9589, 2.5775, 3.4054), 10: (1.6849, 2.1596, 3.4951), 14: (1.0147, 2.5411, 2.7957)}


def lab2(image):
    """Corrected tangents, object points, c and start values of one photograph of document 003."""
    x0, y0, c, K1, K2, K3, P1, P2 = np.genfromtxt(
        LAB2 / "lab2_camera.csv", delimiter=",", skip_header=1, usecols=1
    )
    seen = np.loadtxt(LAB2 / "lab2_image_points_mm.csv", delimiter=",", skiprows=1)
    seen = seen[seen[:, 0] == image]
    points = np.loadtxt(LAB2 / "lab2_object_points_m.csv", delimiter=",", skiprows=1)
    x, y = seen[:, 2] - x0, seen[:, 3] - y0
    r2 = x * x + y * y
    radial = K1 * r2 + K2 * r2**2 + K3 * r2**3
    xc = x - x * radial - P1 * (r2 + 2 * x * x) - 2 * P2 * x * y
    yc = y - y * radial - P2 * (r2 + 2 * y * y) - 2 * P1 * x * y
    rows = np.loadtxt(
        LAB2 / "lab2_exterior_orientation.csv", delimiter=",", skiprows=1, usecols=(0, 2, 3, 4, 5, 6, 7)
    )
    start = rows[rows[:, 0] == image][0, 1:]  # the first row of an image is its start value
    return np.stack([xc, yc], axis=1) / c, points[seen[:, 1].astype(int) - 1, 1:], c, start


@pytest.mark.parametrize(("image", "n", "X0", "angles", "variance", "printed"), TRUTH)
def test_document_003(image, n, X0, angles, variance, printed):
    tangents, points, c, start = lab2(image)
    result = resect_least_squares(tangents, points, start[:3], rotation_from_angles(*np.radians(start[3:])))
    assert result.converged and len(points) == n
    np.testing.assert_allclose(result.position, X0, atol=1e-7)
    np.testing.assert_allclose(np.degrees(angles_from_rotation(result.rotation)), angles, atol=1e-6)
    assert result.redundancy == 2 * n - 6
    sigma0_squared = (result.sigma0 * c) ** 2
    assert sigma0_squared == pytest.approx(variance, rel=1e-6)
    # the document divides by n - 6 instead of 2n - 6: its own figure comes out with its own divisor
    assert sigma0_squared * (2 * n - 6) / (n - 6) == pytest.approx(printed, rel=5e-4)
    deviations = np.sqrt(np.diag(result.covariance) * (2 * n - 6) / (n - 6))
    np.testing.assert_allclose(deviations, PRINTED_SD[image], rtol=1e-4)
    np.testing.assert_allclose(result.history[0, :3], start[:3])
    if image in FIRST_STEP:
        np.testing.assert_allclose(result.history[1, :3], FIRST_STEP[image], atol=5.1e-5)
    np.testing.assert_allclose(result.history[-1, :3], result.position)


@pytest.mark.skipif(not SHARED.exists(), reason="../shared/data/resection is not here")
def test_textbook_example():
    omega, phi, kappa, X, Y, Z, x0, y0, f = (float(v) for v in (SHARED / "cam.inp").read_text().split())
    rows = [line.split() for line in (SHARED / "resect.inp").read_text().splitlines() if line.strip()]
    table = np.array([[float(v) for v in row[1:]] for row in rows])
    tangents = (table[:, :2] - (x0, y0)) / f
    result = resect_least_squares(
        tangents, table[:, 2:], np.array([X, Y, Z]), rotation_from_angles(omega, phi, kappa)
    )
    printed = (-0.006507481, -0.008521803, -1.575322124)
    np.testing.assert_allclose(angles_from_rotation(result.rotation), printed, atol=5e-10)
    np.testing.assert_allclose(result.position, (914260.42186, 575441.83555, 839.13044), atol=5e-6)
    assert np.sum((result.residuals * f) ** 2) == pytest.approx(0.00075110488, abs=5e-12)


def _scene(rng, n=8):
    points = rng.normal(size=(n, 3))
    R = rotation_from_angles(0.3, -0.4, 1.2)
    X0 = R @ np.array([0.1, 0.2, 6.0])
    UVW = (points - X0) @ R
    return points, X0, R, -UVW[:, :2] / UVW[:, 2:]


def test_normal_equations_against_differences():
    points, X0, R, _ = _scene(seed_of("jacobian"))
    n = len(points)
    measured = seed_of("measured").normal(size=(n, 2)) * 0.01
    A = seed_of("weights").normal(size=(n, 2, 2))
    P = A @ np.swapaxes(A, 1, 2)

    def residuals(x):
        UVW = (points - X0 - x[:3]) @ (R @ rotation_from_vector(x[3:]))
        return (-UVW[:, :2] / UVW[:, 2:] - measured).ravel()

    h = 1e-6
    J = np.stack([(residuals(e) - residuals(-e)) / (2 * h) for e in np.eye(6) * h], axis=1).reshape(n, 2, 6)
    v = residuals(np.zeros(6)).reshape(n, 2)
    N, b, out = np.empty((6, 6)), np.empty(6), np.empty((n, 2))
    cost, distance = pose_normals(measured, points, P, np.ones(n, dtype=bool), X0, R, N, b, out)
    np.testing.assert_allclose(N, np.einsum("nia,nij,njb->ab", J, P, J), rtol=1e-7, atol=1e-6)
    np.testing.assert_allclose(b, -np.einsum("nia,nij,nj->a", J, P, v), rtol=1e-7, atol=1e-7)
    assert cost == pytest.approx(np.einsum("ni,nij,nj", v, P, v))
    assert distance == pytest.approx(np.linalg.norm(points - X0, axis=1).mean())


def test_dispersion_is_that_of_many_solutions():
    rng = seed_of("dispersion")
    points, X0, R, uv = _scene(rng, n=12)
    sigma = 1e-4
    true = np.concatenate([X0, angles_from_rotation(R)])
    mahalanobis = []
    for _ in range(300):
        result = resect_least_squares(uv + sigma * rng.standard_normal(uv.shape), points, X0, R)
        d = np.concatenate([result.position, angles_from_rotation(result.rotation)]) - true
        mahalanobis.append(d @ np.linalg.solve(sigma**2 * result.cofactors, d))
    # chi^2 with 6 degrees of freedom: mean 6, standard deviation of the mean of 300 is 0.2
    assert np.mean(mahalanobis) == pytest.approx(6, abs=4 * np.sqrt(12 / 300))


def test_no_error_at_the_truth_and_from_afar():
    points, X0, R, uv = _scene(seed_of("truth"))
    exact = resect_least_squares(uv, points, X0, R)
    assert exact.rms < 1e-14
    far = resect_least_squares(uv, points, 1.3 * X0, R @ rotation_from_vector(np.array([0.1, -0.1, 0.4])))
    np.testing.assert_allclose(far.position, X0, atol=1e-10)


def test_refusals():
    points, X0, R, uv = _scene(seed_of("refusals"))
    with pytest.raises(GeometryError, match="2 points, least squares needs at least 3"):
        resect_least_squares(uv[:2], points[:2], X0, R)
    with pytest.raises(GeometryError, match="behind the camera"):
        resect_least_squares(uv, points, -X0, R)
    line = np.outer(np.linspace(-1, 1, 6), [1.0, 0.5, 0.2])
    UVW = (line - X0) @ R
    with pytest.raises(GeometryError, match="collinear or coincident"):
        resect_least_squares(-UVW[:, :2] / UVW[:, 2:], line, X0, R)
