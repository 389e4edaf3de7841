"""Fiducial marks, corrections of photo coordinates with inverses, pixel and photo coordinates."""

import numpy as np
import pytest

from sfm.model.conventions import rotation_from_angles
from sfm.model.errors import GeometryError
from sfm.textbook.photo_coordinates import (
    PhotoCorrections,
    RadialTable,
    compute_photo_coordinates,
    correct_photo_coordinates,
    curvature_displacement,
    distort_photo_coordinates,
    orient_fiducials,
    photo_from_pixel,
    pixel_from_photo,
    radial_from_table,
    refraction_coefficient,
)
from tests.places import ROOT
from tests.synthetic import seed_of

STEREO = ROOT / "datasets/stereo10/stereo10_points.csv"
MARKS = np.array(
    [[-106.0, -106], [106, -106], [106, 106], [-106, 106], [0, 113], [113, 0], [0, -113], [-113, 0]]
)
SIZE, PIXEL = (1936, 1296), np.array([23.6 / 1936, 15.8 / 1296])


def test_pixel_to_photo_coordinates_of_document_002():
    table = np.loadtxt(STEREO, delimiter=",", skiprows=1)
    for pixel, printed in ((table[:, 1:3], table[:, 5:7]), (table[:, 3:5], table[:, 7:9])):
        # the document's formula has rows downwards, its table was made with rows upwards
        photo = photo_from_pixel(pixel, SIZE, PIXEL, rows="up")
        np.testing.assert_allclose(photo, printed, atol=5.5e-6)
        down = photo_from_pixel(pixel, SIZE, PIXEL)
        np.testing.assert_allclose(down, photo * (1, -1), atol=1e-12)
        for rows, value in (("up", photo), ("down", down)):
            np.testing.assert_allclose(pixel_from_photo(value, SIZE, PIXEL, rows=rows), pixel, atol=1e-9)
    with pytest.raises(GeometryError, match="expected one of down, up"):
        photo_from_pixel(pixel, SIZE, PIXEL, rows="left")


@pytest.mark.parametrize("kind", ["similarity", "affine"])
def test_fiducials_exact(kind):
    alpha, epsilon = 0.02, 0.0 if kind == "similarity" else 3e-4
    sx, sy = 0.021, 0.021 if kind == "similarity" else 0.02102
    matrix = np.array(
        [
            [sx * np.cos(alpha), -sy * np.sin(alpha + epsilon)],
            [sx * np.sin(alpha), sy * np.cos(alpha + epsilon)],
        ]
    )
    measured = (MARKS - (3.0, -4.0)) @ np.linalg.inv(matrix).T
    result = orient_fiducials(measured, MARKS, kind=kind)
    np.testing.assert_allclose(result.matrix, matrix, rtol=1e-10)
    np.testing.assert_allclose(result.shift, (3.0, -4.0), atol=1e-10)
    assert np.abs(result.residuals).max() < 1e-11
    assert result.rotation == pytest.approx(alpha) and result.shear == pytest.approx(epsilon, abs=1e-12)
    np.testing.assert_allclose(result.scales, (sx, sy))
    np.testing.assert_allclose(result.invert(result.apply(measured)), measured, atol=1e-8)


@pytest.mark.parametrize(("kind", "parameters"), [("similarity", 4), ("affine", 6)])
def test_fiducials_covariance(kind, parameters):
    rng = seed_of(f"fiducials {kind}")
    matrix, shift = np.array([[0.0210, -0.0004], [0.0004, 0.0210]]), np.array([3.0, -4.0])
    measured = (MARKS - shift) @ np.linalg.inv(matrix).T
    true = (
        np.array([0.021, 0.0004, *shift])
        if kind == "similarity"
        else np.array([0.021, -0.0004, shift[0], 0.0004, 0.021, shift[1]])
    )
    squares, variances = [], []
    for _ in range(400):
        result = orient_fiducials(measured, MARKS + 0.005 * rng.standard_normal(MARKS.shape), kind=kind)
        M, t = result.matrix, result.shift
        found = (
            [M[0, 0], M[1, 0], *t]
            if kind == "similarity"
            else [M[0, 0], M[0, 1], t[0], M[1, 0], M[1, 1], t[1]]
        )
        d = np.array(found) - true
        squares.append(d @ np.linalg.solve(result.covariance / result.sigma0**2 * 0.005**2, d))
        variances.append(result.sigma0**2)
    assert result.redundancy == 16 - parameters
    assert np.mean(squares) == pytest.approx(parameters, abs=4 * np.sqrt(2 * parameters / 400))
    assert np.mean(variances) == pytest.approx(0.005**2, rel=4 * np.sqrt(2 / result.redundancy / 400))


def test_fiducials_refusals():
    with pytest.raises(GeometryError, match="2 marks, affine needs at least 3"):
        orient_fiducials(MARKS[:2], MARKS[:2])
    with pytest.raises(GeometryError, match="on one line"):
        orient_fiducials(MARKS[[0, 1, 1]], MARKS[:3])
    with pytest.raises(GeometryError, match="kind 'conformal', expected one of similarity, affine"):
        orient_fiducials(MARKS, MARKS, kind="conformal")
    assert np.isnan(orient_fiducials(MARKS[:2], MARKS[:2], kind="similarity").sigma0)


TABLE = RadialTable(np.array([0.0, 50, 100, 150]), np.array([0.0, 0.004, -0.002, 0.01]))
ALL = PhotoCorrections(
    principal_point_mm=np.array([0.02, -0.03]),
    radial_table=TABLE,
    radial=np.array([2e-9, -1e-14, 0.0]),
    decentring=np.array([1e-8, -2e-8]),
    flying_height_km=3.0,
    terrain_height_km=0.5,
    curvature_height_km=2.5,
)
EACH = {
    "principal point": PhotoCorrections(principal_point_mm=ALL.principal_point_mm),
    "table": PhotoCorrections(radial_table=TABLE),
    "polynomial": PhotoCorrections(radial=np.array([2e-7, -1e-12, 1e-18])),
    "decentring": PhotoCorrections(decentring=np.array([1e-6, -2e-6])),
    "refraction": PhotoCorrections(flying_height_km=3.0, terrain_height_km=0.5),
    "curvature": PhotoCorrections(curvature_height_km=2.5),
    "all": ALL,
}


@pytest.mark.parametrize("name", EACH)
def test_every_correction_has_its_inverse(name):
    xy = seed_of(name).uniform(-90, 90, (200, 2))
    corrected = correct_photo_coordinates(xy, EACH[name], c_mm=152.0)
    assert np.abs(corrected - xy).max() > 1e-4
    np.testing.assert_allclose(distort_photo_coordinates(corrected, EACH[name], c_mm=152.0), xy, atol=1e-10)
    np.testing.assert_array_equal(correct_photo_coordinates(xy, PhotoCorrections(), c_mm=152.0), xy)


def test_values_by_hand():
    # linear interpolation half way between 50 and 100 mm: (0.004 - 0.002) / 2
    assert radial_from_table(TABLE, np.array([75.0]))[0] == pytest.approx(0.001)
    moved = correct_photo_coordinates(
        np.array([[75.0, 0.0]]), PhotoCorrections(radial_table=TABLE), c_mm=152.0
    )
    np.testing.assert_allclose(moved, [[74.999, 0.0]])  # the image was displaced outwards by 0.001
    # H = 1 km, h = 0: K = 2410 / 245 1e-6
    assert refraction_coefficient(1.0, 0.0) == pytest.approx(2410 / 245 * 1e-6)
    K = refraction_coefficient(3.0, 0.5)
    by_hand = (2410 * 3 / (9 - 18 + 250) - 2410 * 0.25 / ((0.25 - 3 + 250) * 3)) * 1e-6
    assert by_hand == pytest.approx(K)
    inward = correct_photo_coordinates(np.array([[0.0, 100.0]]), EACH["refraction"], c_mm=152.0)
    assert inward[0, 1] == pytest.approx(100 - K * (100 + 100**3 / 152**2))
    # H r^3 / (2 R c^2): 2.5 km, 100 mm, 152 mm
    assert curvature_displacement(100.0, height_km=2.5, c_mm=152.0) == pytest.approx(
        2.5e6 / (2 * 6372.2 * 152**2)
    )
    outward = correct_photo_coordinates(np.array([[0.0, 100.0]]), EACH["curvature"], c_mm=152.0)
    assert outward[0, 1] == pytest.approx(100 + 2.5e6 / (2 * 6372.2 * 152**2))


def test_curvature_against_a_sphere():
    """The formula against points on a sphere seen from above, to its neglected terms."""
    H, c, R = 2.5, 152.0, 6372.2
    ground = np.linspace(0.2, 1.5, 8)  # km along the arc
    x, z = R * np.sin(ground / R), R * (np.cos(ground / R) - 1)
    seen = c * x / (H - z)
    plane = c * ground / H
    corrected = seen + curvature_displacement(seen, height_km=H, c_mm=c)
    np.testing.assert_allclose(corrected, plane, atol=2e-5)
    assert np.abs(seen - plane).max() > 1e-3


def test_simulated_photo_coordinates():
    rng = seed_of("simulated")
    R = rotation_from_angles(0.02, -0.03, 1.0)
    X0 = np.array([1000.0, 2000.0, 1500.0])
    ground = np.stack(
        [rng.uniform(500, 1500, 50), rng.uniform(1500, 2500, 50), rng.uniform(0, 50, 50)], axis=1
    )
    ideal = compute_photo_coordinates(ground, X0, R, c_mm=152.0)
    UVW = (ground - X0) @ R
    np.testing.assert_allclose(ideal, -152 * UVW[:, :2] / UVW[:, 2:], rtol=1e-12)
    real = compute_photo_coordinates(ground, X0, R, c_mm=152.0, corrections=ALL)
    np.testing.assert_allclose(correct_photo_coordinates(real, ALL, c_mm=152.0), ideal, atol=1e-10)
    assert np.isnan(compute_photo_coordinates(X0[None] + R[:, 2] * 10, X0, R, c_mm=152.0)).all()


def test_correction_refusals():
    with pytest.raises(GeometryError, match=r"a point at 200.000 mm, the table ends at 150.000 mm"):
        correct_photo_coordinates(np.array([[200.0, 0.0]]), EACH["table"], c_mm=152.0)
    with pytest.raises(GeometryError, match="must ascend from 0"):
        radial_from_table(RadialTable(np.array([1.0, 0.5]), np.zeros(2)), np.array([0.7]))
    with pytest.raises(GeometryError, match="it must be above the terrain"):
        refraction_coefficient(0.3, 0.5)
