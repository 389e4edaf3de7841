"""Adjustments against published and independently computed results."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest

from adapters.formats.bundle_text import read_bundle_csharp
from adapters.formats.photomodeler import read_photomodeler
from adapters.formats.sba_text import read_sba_text
from sfm.adjustment.datum import Datum
from sfm.adjustment.result import Adjustment
from sfm.adjustment.solve import AdjustmentOptions, adjust
from sfm.model.camera import camera_from_values
from sfm.model.conventions import angles_from_rotation, pixel_from_image, rotation_from_angles
from sfm.model.estimate import Estimate
from sfm.model.network import ImagePoints, Network, ObjectPoints
from tests.places import ROOT
from tests.tables import rows_of

FLYOVER, LAB2 = ROOT / "datasets/flyover", ROOT / "datasets/lab2"
SHARED = ROOT.parent / "shared/data"
CAMCAL = SHARED / "camcal"
SBA = SHARED / "sba"
needs_camcal = pytest.mark.skipif(not CAMCAL.exists(), reason="needs ../shared/data/camcal")
needs_sba = pytest.mark.skipif(not SBA.exists(), reason="needs ../shared/data/sba")
GRID_PX, GRID_MM = (10_001, 10_001), np.array([0.001, 0.001])  # pixels for image coordinates given in mm


def mm_network(
    rows: list[dict[str, str]], points: tuple[str, ...], sigma: tuple[str, str] | float
) -> tuple[tuple[str, ...], ImagePoints]:
    """Image points given in mm, as pixels of a fine grid."""
    images = tuple(dict.fromkeys(row["image"] for row in rows))
    xy = np.array([[float(row["x"]), float(row["y"])] for row in rows])
    covariance = np.zeros((len(rows), 2, 2))
    for k, row in enumerate(rows):
        s = [sigma, sigma] if isinstance(sigma, float) else [float(row[name]) for name in sigma]
        covariance[k] = np.diag((np.array(s) / GRID_MM) ** 2)
    return images, ImagePoints(
        np.array([images.index(row["image"]) for row in rows]),
        np.array([points.index(row["point"]) for row in rows]),
        pixel_from_image(xy, GRID_PX, GRID_MM),
        covariance,
    )


def flyover() -> tuple[Network, Estimate]:
    points = rows_of(FLYOVER / "flyover_object_points_m.csv")
    names = tuple(row["point"] for row in points)
    images, image_points = mm_network(
        rows_of(FLYOVER / "flyover_image_points_mm.csv"), names, ("sigma_x", "sigma_y")
    )
    exterior = rows_of(FLYOVER / "flyover_exterior_orientation.csv")
    angles = np.radians([[float(row[f"{a}_deg"]) for a in ("omega", "phi", "kappa")] for row in exterior])
    estimate = Estimate(
        (camera_from_values("35 mm", "brown", GRID_PX, (GRID_MM[0], GRID_MM[1]), c_mm=35.0),),
        np.array([[float(row[f"{a}_m"]) for a in ("X0", "Y0", "Z0")] for row in exterior]),
        np.array([rotation_from_angles(*a) for a in angles]),
        np.array([[float(row[f"{a}_approx"]) for a in "XYZ"] for row in points]),
    )
    return Network(images, np.zeros(2, dtype=np.int64), names, image_points), estimate


def test_flyover_as_a_free_network() -> None:
    """Figures recomputed from the published measurements: datasets/flyover/README.md."""
    network, start = flyover()
    a = adjust(
        network, start, datum=Datum("free"), reject="none", options=AdjustmentOptions(method="gauss-newton")
    )
    assert a.converged
    assert (a.defect, a.redundancy, a.unknowns) == (7, 3, 36)
    assert a.sigma0**2 * a.redundancy == pytest.approx(2.355596, abs=5e-7)
    assert a.sigma0 == pytest.approx(0.886114, abs=5e-7)
    assert a.rms_px * GRID_MM[0] * 1000 == pytest.approx(0.0715, abs=5e-5)
    limiting = np.sqrt(np.diagonal(a.covariance.points_limiting[0])) / a.sigma0
    # recomputed with inner constraints on cameras too, which scales the network by 7e-4
    assert limiting == pytest.approx([1.921e-5, 1.574e-5, 2.344e-5], rel=1e-3)
    published = np.array([1.925e-5, 1.574e-5, 2.344e-5])
    assert limiting == pytest.approx(published, rel=3e-3)
    ratio = np.sqrt(np.diagonal(a.covariance.points, axis1=1, axis2=2)) / np.sqrt(
        np.diagonal(a.covariance.points_limiting, axis1=1, axis2=2)
    )
    assert np.median(ratio) > 3  # what was published as the precision of the points is far too good


def test_pair8_as_a_free_network() -> None:
    """Figure 4.1 of document 000; truth by scipy, see datasets/pair8/README.md."""
    network, start = read_bundle_csharp(ROOT / "datasets/pair8/pair8.txt")
    a = adjust(network, start, datum=Datum("free"), reject="none")
    assert (a.converged, a.defect, a.redundancy) == (True, 7, 3)
    assert a.sigma0**2 * a.redundancy == pytest.approx(0.0016292397, rel=1e-6)
    assert a.sigma0 == pytest.approx(0.0233040751, rel=1e-6)
    assert a.rms_px * a.estimate.cameras[0].pixel_mm[0] * 1000 == pytest.approx(0.240769, rel=1e-5)
    X = a.estimate.points
    ratio = np.linalg.norm(X[0] - X[6]) / np.linalg.norm(X[3] - X[7])
    assert ratio == pytest.approx(1.2719356187, rel=1e-7)


def test_flyover_corrections_added_to_degrees_do_not_adjust() -> None:
    """Why the published solutions are not adjusted: a correction in radians added to degrees hardly turns."""
    network, start = flyover()
    best = adjust(network, start, datum=Datum("free"), reject="none")
    estimate = start
    for _ in range(12):
        solution = adjust(
            network,
            estimate,
            datum=Datum("free"),
            reject="none",
            options=AdjustmentOptions(method="gauss-newton", max_iterations=1),
        )
        step = angles_from_rotation(solution.estimate.rotation) - angles_from_rotation(estimate.rotation)
        wrong = angles_from_rotation(estimate.rotation) + np.radians(step)
        estimate = replace(solution.estimate, rotation=np.array([rotation_from_angles(*w) for w in wrong]))
    stuck = adjust(
        network, estimate, datum=Datum("free"), reject="none", options=AdjustmentOptions(max_iterations=0)
    )
    assert stuck.rms_px > 2 * best.rms_px


def test_lab2_resections_in_one_network() -> None:
    """Document 003's photographs with fixed camera and points: datasets/lab2/README.md."""
    values = {row["parameter"]: float(row["value"]) for row in rows_of(LAB2 / "lab2_camera.csv")}
    camera = camera_from_values(
        "lab 2",
        "brown_dbat",
        GRID_PX,
        (GRID_MM[0], GRID_MM[1]),
        c_mm=values.pop("c"),
        values=tuple((name, v if name in ("x0", "y0") else -v) for name, v in values.items()),  # see README
    )
    points = rows_of(LAB2 / "lab2_object_points_m.csv")
    names = tuple(row["point"] for row in points)
    xyz = np.array([[float(row[a]) for a in "XYZ"] for row in points])
    images, image_points = mm_network(rows_of(LAB2 / "lab2_image_points_mm.csv"), names, 0.01)
    rows = rows_of(LAB2 / "lab2_exterior_orientation.csv")
    first = {row["image"]: row for row in rows if row["kind"] == "initial"}
    angles = np.radians([[float(first[i][f"{a}_deg"]) for a in ("omega", "phi", "kappa")] for i in images])
    start = Estimate(
        (camera,),
        np.array([[float(first[i][f"{a}_m"]) for a in ("X0", "Y0", "Z0")] for i in images]),
        np.array([rotation_from_angles(*a) for a in angles]),
        xyz,
    )
    control = ObjectPoints(np.arange(len(names)), xyz, np.zeros((len(names), 3, 3)))
    network = Network(images, np.zeros(4, dtype=np.int64), names, image_points, observations=(control,))
    a = adjust(network, start, datum=Datum("control"), reject="none")
    assert a.converged
    assert (a.defect, a.unknowns) == (0, 24)
    expected = {  # X0 Y0 Z0 (m), omega phi kappa (deg), sigma0^2 (mm^2) with redundancy 2 n - 6
        "9": (1.8896867, 3.0358662, 3.7350004, -19.1841784, -4.3449776, 2.0501490, 9.358634e-5),
        "10": (1.6804833, 2.1658782, 3.5085583, -0.4149385, -4.9369395, 92.4769822, 1.796144e-5),
        "14": (1.0095213, 2.5331665, 2.8063507, -8.9397591, -17.0517497, 91.1811604, 2.930867e-5),
        "18": (2.1016108, 1.1946515, 3.6995847, 13.3667930, 1.4654585, 90.2308179, 5.900370e-5),
    }
    found = np.degrees(angles_from_rotation(a.estimate.rotation))
    for i, name in enumerate(images):
        assert a.estimate.position[i] == pytest.approx(expected[name][:3], abs=1e-7)
        assert found[i] == pytest.approx(expected[name][3:6], abs=1e-6)
        v = a.residuals[image_points.image == i] * GRID_MM[0]
        assert (v**2).sum() / (v.size - 6) == pytest.approx(expected[name][6], rel=1e-6)

    weighted = network.with_given(replace(control, covariance=np.tile(1e-6 * np.eye(3), (len(names), 1, 1))))
    b = adjust(weighted, start, datum=Datum("control"), reject="none")
    assert b.converged
    assert b.redundancy == a.redundancy  # each observed coordinate brings one unknown
    assert (b.residuals**2).sum() < (a.residuals**2).sum()


@needs_sba
@pytest.mark.parametrize(("cameras", "start", "optimum"), [(7, 19.0947, 0.675396), (54, 2.14707, 0.176473)])
def test_sba_problems_reach_the_printed_optimum(cameras: int, start: float, optimum: float) -> None:
    network, estimate = read_sba_text(
        SBA / f"{cameras}cams.txt", SBA / f"{cameras}pts.txt", SBA / "calib.txt"
    )

    def mean_square(a: Adjustment) -> float:
        return float((a.residuals**2).sum() / len(a.residuals))

    def run(**options: int) -> Adjustment:
        return adjust(
            network,
            estimate,
            datum=Datum("free"),
            reject="none",
            covariance=False,
            options=AdjustmentOptions(**options),
        )

    assert mean_square(run(max_iterations=0)) == pytest.approx(start, rel=5e-6)
    a = run()
    assert a.converged
    assert a.defect == 7
    assert mean_square(a) == pytest.approx(optimum, abs=5.1e-7)


def report_values() -> tuple[dict[str, tuple[str, str]], list[dict[str, tuple[str, str]]]]:
    """Value and deviation, as printed, of the camera and of each photograph in DBAT's report."""
    text = (CAMCAL / "camcal-dbatreport.txt").read_text(encoding="utf-8")
    numbers = r":\n\s+Value:\s+(\S+)[^\n]*\n\s+Deviation:\s+(\S+)"
    interior = re.findall(r"(Camera Constant|px|py|K1|K2|K3|P1|P2|as)[^\n]*" + numbers, text)
    exterior = [
        re.findall(r"(Omega|Phi|Kappa|Xc|Yc|Zc)" + numbers, part)
        for part in re.split(r"Photo \d+: P82500", text)[1:]
    ]
    return (
        {name: (value, deviation) for name, value, deviation in interior},
        [{name: (value, deviation) for name, value, deviation in part} for part in exterior],
    )


def agrees(value: float, printed: str) -> bool:
    """Whether a value rounds to the printed digits; one unit more for values that sit on the edge."""
    mantissa, _, power = printed.partition("e")
    digits = len(mantissa.partition(".")[2])
    unit = 10.0 ** (int(power or 0) - digits)
    return abs(value - float(printed)) <= 0.502 * unit


@needs_camcal
@pytest.mark.parametrize("method", ["gauss-newton", "levenberg-marquardt"])
def test_camcal_with_fixed_control_prints_as_the_report_of_dbat(method: str) -> None:
    network, start = read_photomodeler(CAMCAL / "camcal-pmexport.txt", control=CAMCAL / "camcal-fixed.txt")
    c = start.cameras[0]
    pixel = np.full(2, 5.43764 / 1704)  # DBAT's affinity is relative to square pixels of the format height
    rough = replace(
        camera_from_values(c.name, "brown_dbat", c.size_px, (pixel[0], pixel[1]), c_mm=7.3), free=c.free
    )
    start = replace(start, cameras=(rough,))
    a = adjust(
        network, start, datum=Datum("control"), reject="none", options=AdjustmentOptions(method=method)
    )
    assert a.converged
    assert (a.redundancy, a.unknowns, a.observations, a.defect) == (3725, 423, 4148, 0)
    assert agrees(a.sigma0_px, "0.16148")
    assert agrees(a.rms_px * np.sqrt(2), "0.216")
    assert agrees(a.max_residual_px, "0.955")

    printed, photographs = report_values()
    camera = a.estimate.cameras[0]
    sigma = np.zeros(len(camera.names))
    sigma[camera.free] = np.sqrt(np.diagonal(a.covariance.interior[0]))
    found = dict(zip(camera.names, zip(camera.parameters, sigma, strict=True), strict=True))
    width, height = camera.size_px
    found["x0"] = (pixel[0] * width / 2 + found["x0"][0], found["x0"][1])
    found["y0"] = (pixel[1] * height / 2 - found["y0"][0], found["y0"][1])
    names = {"Camera Constant": "c", "px": "x0", "py": "y0", "as": "b1"}
    assert len(printed) == 9
    for name, (value, deviation) in printed.items():
        ours = found[names.get(name, name)]
        assert agrees(ours[0], value), name
        assert agrees(ours[1], deviation), name

    angles = np.degrees(angles_from_rotation(a.estimate.rotation))
    sigmas = np.sqrt(np.diagonal(a.covariance.exterior, axis1=1, axis2=2))
    assert len(photographs) == 21
    for i, values in enumerate(photographs):
        assert len(values) == 6
        for s, name in enumerate(("Xc", "Yc", "Zc", "Omega", "Phi", "Kappa")):
            value, deviation = values[name]
            ours = a.estimate.position[i, s] if s < 3 else angles[i, s - 3]
            ours -= 0 if s < 3 else 360 * round((ours - float(value)) / 360)
            assert agrees(ours, value), (i, name)
            assert agrees(sigmas[i, s] if s < 3 else np.degrees(sigmas[i, s]), deviation), (i, name)

    points = np.sqrt(np.diagonal(a.covariance.points, axis1=1, axis2=2))
    length = np.sqrt((points**2).sum(axis=1))
    free = length > 0
    assert agrees(length[free].min(), "8.2e-05")
    assert agrees(length.max(), "0.00011")
    assert network.points[int(length.argmax())] == "90"
    assert network.points[int(np.flatnonzero(free)[length[free].argmin()])] == "49"
    for maximum, text in zip(points.max(axis=0), ("5e-05", "5.3e-05", "8.5e-05"), strict=True):
        assert agrees(maximum, text)


@needs_camcal
def test_camcal_as_a_free_network() -> None:
    network, start = read_photomodeler(CAMCAL / "camcal-pmexport.txt", control=CAMCAL / "camcal-fixed.txt")
    pixel = np.full(2, 5.43764 / 1704)
    start = replace(start, cameras=(replace(start.cameras[0], model="brown_dbat", pixel_mm=pixel),))
    a = adjust(network, start, datum=Datum("free"), reject="none")
    assert (a.redundancy, a.unknowns, a.defect) == (3720, 435, 7)
    assert agrees(a.sigma0_px, "0.142614")
    assert agrees(a.rms_px, "0.135057")
    assert agrees(a.max_residual_px, "0.8778")
    expected = {"c": 7.456893, "K1": 0.004599155, "K2": -4.599046e-5, "K3": -2.023446e-6}
    expected |= {"P1": -6.102879e-5, "P2": -4.589405e-5, "b1": 3.916193e-4}
    for name, value in expected.items():
        assert a.estimate.cameras[0].value(name) == pytest.approx(value, rel=3e-7)


BROWN_FREE = ("c", "x0", "y0", "K1", "K2", "K3", "P1", "P2")
DBAT_MODELS = {  # number: our model, free parameters, redundancy, sigma0 in px, c in mm, with fixed control
    1: ("brown_dbat", BROWN_FREE, 3726, 0.168901, 7.457396),
    2: ("brown_dbat", BROWN_FREE, 3726, 0.168901, 7.457396),
    3: ("brown_dbat", (*BROWN_FREE, "b1"), 3725, 0.161480, 7.456995),
    4: ("brown_affine_dbat", (*BROWN_FREE, "b1"), 3725, 0.161247, 7.457019),
    5: ("brown_dbat", (*BROWN_FREE, "b1"), 3725, 0.161480, 7.456995),
    -1: ("brown_forward", BROWN_FREE, 3726, 0.162168, 7.457482),
}


def dbat_residuals(number: int, p: dict[str, float], xy: np.ndarray, uv: np.ndarray, s: float) -> np.ndarray:
    """Residuals in px by DBAT's own formulas, millimetres counted from the corner of the photograph."""
    px = s * 2272 / 2 + p["x0"]
    py = s * 1704 / 2 - p["y0"]
    col, y = s * (xy[:, 0] + 0.5), py - s * (xy[:, 1] + 0.5)
    a1 = 1 + p["b1"]
    ideal = p["c"] * uv

    def lens(x: np.ndarray, y: np.ndarray) -> np.ndarray:
        r2 = x**2 + y**2
        radial = p["K1"] * r2 + p["K2"] * r2**2 + p["K3"] * r2**3
        dx = x * radial + p["P1"] * (r2 + 2 * x**2) + 2 * p["P2"] * x * y
        dy = y * radial + p["P2"] * (r2 + 2 * y**2) + 2 * p["P1"] * x * y
        return np.stack([dx, dy], axis=1)

    measured = np.stack([col - px, y], axis=1)
    if number == -1:  # distortion of the projected point
        v = ideal + lens(*ideal.T) - measured
    elif number in (1, 2):  # no affinity
        v = ideal - measured - lens(*measured.T)
    elif number == 3:  # affinity before the lens
        stretched = measured * [a1, 1.0]
        v = ideal - stretched - lens(*stretched.T)
    elif number == 4:  # and behind it
        v = ideal - (measured + lens(*measured.T)) * [a1, 1.0]
    else:  # aspect before the principal point, which is thereby another number: (1 + b1) px
        stretched = np.stack([a1 * col - a1 * px, y], axis=1)
        v = ideal - stretched - lens(*stretched.T)
    return np.asarray(v / s)


@needs_camcal
@pytest.mark.parametrize("number", DBAT_MODELS)
def test_camcal_with_the_six_camera_models_of_dbat(number: int) -> None:
    """Models 1 and 2 are `brown_dbat` without affinity, 3 is the report's, 5 has another principal point."""
    model, free, redundancy, sigma0_px, c = DBAT_MODELS[number]
    network, start = read_photomodeler(CAMCAL / "camcal-pmexport.txt", control=CAMCAL / "camcal-fixed.txt")
    s = 5.43764 / 1704
    camera = camera_from_values("A", model, start.cameras[0].size_px, (s, s), c_mm=7.3, free=free)
    a = adjust(network, replace(start, cameras=(camera,)), datum=Datum("control"), reject="none")
    assert a.converged and a.defect == 0 and a.redundancy == redundancy
    assert agrees(a.sigma0_px, f"{sigma0_px:.6f}")
    found = a.estimate.cameras[0]
    assert agrees(found.value("c"), f"{c:.6f}")
    sigma_c = np.sqrt(a.covariance.interior[0][0, 0])
    assert abs(found.value("c") - 7.45700) < 1.5 * sigma_c  # DBAT's, by model 3
    seen = network.image_points
    d = a.estimate.points[seen.point] - a.estimate.position[seen.image]
    UVW = np.einsum("kji,kj->ki", a.estimate.rotation[seen.image], d)
    p = dict(zip(found.names, found.parameters.tolist(), strict=True))
    uv = -UVW[:, :2] / UVW[:, 2:]
    v = dbat_residuals(number, p, seen.xy, uv, s)
    assert (v**2).sum() == pytest.approx((a.residuals**2).sum(), rel=1e-12)
    for k, name in enumerate(free):  # the sum of squares by DBAT's formulas is least in every parameter
        step = np.sqrt(a.covariance.interior[0][k, k])
        higher = [
            (dbat_residuals(number, p | {name: p[name] + f * step}, seen.xy, uv, s) ** 2).sum() - (v**2).sum()
            for f in (1, -1)
        ]
        assert min(higher) > 0 and higher[0] == pytest.approx(higher[1], rel=1e-2)
