"""PhotoModeler export: origin, angles, units, and refusals that name the line."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from adapters.formats.content import Content, losses
from adapters.formats.photomodeler import read_export, read_photomodeler, write_export
from adapters.formats.registry import format_named, write_any
from sfm.adjustment.datum import Datum
from sfm.adjustment.solve import adjust
from sfm.cli.commands.convert import convert
from sfm.model.camera import camera_from_values, project, tangents_from_pixel
from sfm.model.conventions import angles_from_rotation
from sfm.model.errors import OutputError, SurveyFileError
from sfm.model.estimate import Estimate
from sfm.model.network import Network, ObjectPoints
from sfm.model.solution import Solution
from sfm.pipeline import run_survey
from sfm.survey.inputs.survey import read_survey
from tests.places import SHARED
from tests.synthetic import make_network, observed_anew, seed_of

SHARED = SHARED / "data" / "camcal"

EXPORT = """Two photographs of four points
 0.000500 20 2000 1500
 1.00000  0.10000 10.00000 100.00000 100.00000 100.00000 20.00000 20.00000 20.00000
 10.0004  5.1000  3.8000 10.0000 7.5000 0.00010 0.00000 0.00000 0.00002 -0.00001
 0.00000  0.00725  0.00544 0.500000 0.500000 0.001000 0.000100 0.000100 0.001000 0.001000
   0 C:\\photographs\\one 1.jpg
   0    0.100    0.200    3.000   10.000    2.000   -1.000
   0   0.0002   0.0002   0.0002   0.0029   0.0080   0.0090

   0  10.000   5.100   3.800 10.0000 7.5000 0.00010 0.00000 0.00000 0.00002 -0.00001
   0  0.00000  0.00725  0.00544 0.500000 0.500000 0.001000 0.000100 0.000100 0.001000 0.001000
   1 two.jpg
   1   -0.400    0.200    3.100   90.000  -12.000    4.000
   1   0.0002   0.0002   0.0002   0.0029   0.0080   0.0090

   1  10.000   5.100   3.800 10.0000 7.5000 0.00010 0.00000 0.00000 0.00002 -0.00001
   1  0.00000  0.00725  0.00544 0.500000 0.500000 0.001000 0.000100 0.000100 0.001000 0.001000

       7    0.00000    0.00000    0.00000   0.001000   0.001000   0.002000

       7    0.00010    0.00000    0.00000   0.000040   0.000040   0.000070
       8    0.50000    0.10000    0.00000   0.000040   0.000040   0.000070
       9    0.00000    0.50000    0.10000   0.000040   0.000040   0.000070

   0        7 1000.5000  700.5000  0.10000  0.20000
   0        8 1300.0000  800.0000  0.10000  0.10000
   1        7 1100.2500  751.7500  0.00000  0.00000
   1       12 1200.0000  500.0000  0.10000  0.10000

   1    1        7

   0    1

"""


def write(folder: Path, text: str = EXPORT) -> Path:
    path = folder / "export.txt"
    path.write_text(text, encoding="utf-8")
    return path


def test_every_number_finds_its_place(tmp_path: Path) -> None:
    network, estimate = read_photomodeler(write(tmp_path))
    assert network.images == ("one 1.jpg", "two.jpg")
    assert network.points == ("7", "8", "9", "12")
    (camera,) = estimate.cameras
    assert camera.size_px == (2000, 1500)
    np.testing.assert_allclose(camera.pixel_mm, [0.005, 0.005])
    assert camera.value("c") == 10.0004  # the default camera has more digits than the photographs
    assert camera.value("x0") == pytest.approx(5.1 - 5.0)
    assert camera.value("y0") == pytest.approx(7.5 / 2 - 3.8)
    assert (camera.value("K1"), camera.value("P1"), camera.value("P2")) == (1e-4, 2e-5, -1e-5)
    assert not camera.free.any()  # no calibration project
    text = EXPORT.replace("Two photographs", "Bundle Soln PhotoModeler Calibration Project", 1)
    (camera,) = read_photomodeler(write(tmp_path, text))[1].cameras
    assert [name for name, free in zip(camera.names, camera.free, strict=True) if not free] == ["b2"]
    np.testing.assert_allclose(estimate.position[1], [-0.4, 0.2, 3.1])
    np.testing.assert_allclose(np.rad2deg(angles_from_rotation(estimate.rotation[1])), [4, -12, 90])
    np.testing.assert_allclose(network.image_points.xy[0], [1000.0, 700.0])
    np.testing.assert_allclose(network.image_points.covariance[0], np.diag([0.01, 0.04]))
    np.testing.assert_allclose(network.image_points.covariance[2], np.eye(2))  # no sigma given
    np.testing.assert_allclose(estimate.points[0], [1e-4, 0, 0])
    assert np.isnan(estimate.points[3]).all()
    np.testing.assert_allclose(network.control.xyz, np.zeros((1, 3)))
    np.testing.assert_allclose(network.control.covariance[0], np.diag([1e-6, 1e-6, 4e-6]))


def test_control_file_takes_the_place_of_the_control_block(tmp_path: Path) -> None:
    control = tmp_path / "control.txt"
    control.write_text("# Id,label,X,Y,Z\n8,left,1,2,3\n20,right,4,5,6,0.1,0.2,0.3\n")
    network, estimate = read_photomodeler(write(tmp_path), control=control)
    assert [network.points[j] for j in network.control.point] == ["8", "20"]
    np.testing.assert_allclose(network.control.xyz, [[1, 2, 3], [4, 5, 6]])
    np.testing.assert_allclose(network.control.covariance[1], np.diag([0.01, 0.04, 0.09]))
    np.testing.assert_allclose(estimate.points[1], [0.5, 0.1, 0])  # start value from the export
    control.write_text("8,left,1,2\n")
    with pytest.raises(SurveyFileError, match=r"control\.txt, line 1: 4 fields"):
        read_photomodeler(write(tmp_path), control=control)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        (" 0.000500 20 2000 1500", " 0.000500 20", "line 2: no size of the photographs"),
        (
            "   1 two.jpg",
            "   2 two.jpg",
            "line 12: '2 two.jpg' where photograph 1 and its file were expected",
        ),
        ("   0    0.100    0.200", "   1    0.100    0.200", "line 7: '1' at the start, needed the number 0"),
        ("   0        8 1300.0000", "   0        8 13OO.0000", "line 26: '13OO.0000' is not a number"),
        ("   1       12", "   5       12", "line 28: photograph 5, expected 0 to 1"),
        ("       9    0.00000", "       8    0.00000", "line 23: point 8 is a duplicate"),
        ("  0.10000  0.20000\n", "  0.10000\n", "line 25: 5 numbers, needed 6"),
    ],
)
def test_bad_lines_are_named(old: str, new: str, message: str, tmp_path: Path) -> None:
    assert old in EXPORT
    with pytest.raises(SurveyFileError, match=f"export.txt, {message}"):
        read_photomodeler(write(tmp_path, EXPORT.replace(old, new, 1)))


def export_of(network: Network, truth: Estimate, control: str, *, title: str = "Bundle Soln") -> str:
    """An export as PhotoModeler writes it, with its default standard deviations of the camera."""
    camera = truth.cameras[0]
    xs, ys = np.array(camera.size_px) * camera.pixel_mm
    c, x0, y0 = camera.parameters[:3]
    inner = f"{c} {xs / 2 + x0} {ys / 2 - y0} {xs} {ys} " + " ".join(map(str, camera.parameters[3:8]))
    sigma = f"0 {xs / 1000} {ys / 1000} 0.5 0.5 0.001 0.0001 0.0001 0.001 0.001"
    lines = [title, f"0.0005 20 {camera.size_px[0]} {camera.size_px[1]}", "1 0.1 10 100 100 100 20 20 20"]
    lines += [inner, sigma]
    angles = np.rad2deg(angles_from_rotation(truth.rotation))[:, ::-1]
    for i, name in enumerate(network.images):
        pose = " ".join(map(str, [*truth.position[i], *angles[i]]))
        lines += [f"{i} {name}", f"{i} {pose}", f"{i} 0.1 0.2 0.3 0 0 0", "", f"{i} {inner}", f"{i} {sigma}"]
    points = [f"{j + 1} {x} {y} {z} 0.01 0.02 0.03" for j, (x, y, z) in enumerate(truth.points)]
    seen = network.image_points
    marks = [
        f"{i} {j + 1} {x + 0.5} {y + 0.5} 0.1 0.1"
        for i, j, (x, y) in zip(seen.image, seen.point, seen.xy, strict=True)
    ]
    return "\n".join([*lines, "", *control.splitlines(), "", *points, "", *marks, "", "", ""])


def made() -> tuple[Network, Estimate]:
    network, truth = make_network(seed_of("export"), images=5, points=16, free=())
    values = dict(zip(truth.cameras[0].names, truth.cameras[0].parameters, strict=True)) | {"b1": 0.0}
    camera = truth.cameras[0].with_parameters(np.array(list(values.values())))
    network = observed_anew(network, replace(truth, cameras=(camera,)), 0.1, seed_of("export noise"))
    return network, replace(truth, cameras=(camera,))


def test_negative_sigma_is_a_fixed_point_and_a_camera_is_held_but_in_a_calibration(tmp_path: Path) -> None:
    """As DBAT has them: the adjustment of the file is that of fixed points and the camera as it is."""
    network, truth = made()
    fixed = "\n".join(
        f"{j + 1} {x + 0.001 * j} {y} {z} -0.787602 -0.787602 -0.787602"
        for j, (x, y, z) in enumerate(truth.points[:5])
    )
    read, start = read_photomodeler(write(tmp_path, export_of(network, truth, fixed)))
    a = adjust(read, start, datum="control", reject="none")
    moved = truth.points[:5] + np.outer(np.arange(5) * 0.001, [1, 0, 0])
    np.testing.assert_array_equal(read.control.covariance, 0)
    np.testing.assert_allclose(a.estimate.points[:5], moved, atol=1e-12)
    assert a.redundancy == 2 * len(read.image_points) - 6 * 5 - 3 * 11
    np.testing.assert_array_equal(a.estimate.cameras[0].parameters, start.cameras[0].parameters)
    b = adjust(
        network.with_control([str(j + 1) for j in range(5)], moved),
        replace(truth, cameras=(replace(truth.cameras[0], model="brown_dbat"),)),
        datum="control",
        reject="none",
    )
    np.testing.assert_allclose(a.estimate.position, b.estimate.position, atol=1e-8)
    title = "Bundle Soln PhotoModeler Calibration Project"
    read, start = read_photomodeler(write(tmp_path, export_of(network, truth, fixed, title=title)))
    assert start.cameras[0].free.sum() == 9
    assert adjust(read, start, datum="control", reject="none").redundancy == a.redundancy - 9


def test_posterior_sigma_of_adjusted_control_is_no_prior(tmp_path: Path) -> None:
    network, truth = made()
    rows = [row for row in export_of(network, truth, "").splitlines() if row.endswith(" 0.01 0.02 0.03")][:4]
    path = write(tmp_path, export_of(network, truth, "\n".join(rows)))
    content = read_export(path)
    assert len(content.result.network.control) == 0 and len(content.notes) == 2
    assert content.result.point_covariance is not None and content.result.position_covariance is not None
    np.testing.assert_allclose(content.result.point_covariance[3], np.diag([1e-4, 4e-4, 9e-4]))
    np.testing.assert_allclose(content.result.position_covariance[0], np.diag([0.01, 0.04, 0.09]))
    # the same points are control where their coordinates were observed, and by the file beside the export
    prior = "\n".join(row.replace("0.01 0.02 0.03", "0.001 0.001 0.001") for row in rows)
    content = read_export(write(tmp_path, export_of(network, truth, prior)))
    np.testing.assert_allclose(content.result.network.control.covariance, [np.eye(3) * 1e-6] * 4)
    (tmp_path / "control.txt").write_text("1,a,1,2,3\n2,b,4,5,6,0.1,0.2,0.3\n")
    convert(write(tmp_path), tmp_path / "out", from_format="photomodeler", control=tmp_path / "control.txt")
    survey = read_survey(tmp_path / "out" / "survey.toml")
    assert survey.control is not None and survey.control.names == ("1", "2")


def test_uncoded_points_get_numbers_that_no_other_has(tmp_path: Path) -> None:
    network, truth = made()
    names = (*(f"u{j + 1:03d}" for j in range(12)), "3", "7", "200", "1")
    content = Content(Solution("x", replace(network, points=names), truth))
    write_export(tmp_path / "pm", content)
    again = read_export(tmp_path / "pm").result.network
    numbers = np.array([int(name) for name in again.points])
    assert len(set(numbers)) == 16 and numbers[:12].min() == 201 and numbers[12:].tolist() == [3, 7, 200, 1]
    named = {kind.name: count for kind, count in losses(content, format_named("photomodeler").held(content))}
    assert named["uncoded"] == 12
    lost = replace(
        content, result=replace(content.result, network=replace(network, points=("A", *names[1:])))
    )
    with pytest.raises(OutputError):
        write_export(tmp_path / "no", lost)


def test_pixels_that_are_not_square_become_an_affinity(tmp_path: Path) -> None:
    """As DBAT has them; the rays of the image points are those of pixels as the file states them."""
    (camera,) = read_photomodeler(write(tmp_path))[1].cameras
    (other,) = read_photomodeler(write(tmp_path, EXPORT.replace("10.0000 7.5000", "10.0400 7.5000")))[
        1
    ].cameras
    assert other.pixel_mm.tolist() == camera.pixel_mm.tolist()
    assert other.value("b1") == pytest.approx(0.004)
    xy = np.array([[100.0, 200.0], [1800.0, 1400.0]])
    rectangular = replace(
        camera,
        pixel_mm=np.array([10.04 / 2000, 0.005]),
        parameters=np.array([10.0004, 5.1 - 5.02, 7.5 / 2 - 3.8, *camera.parameters[3:]]),
    )
    np.testing.assert_allclose(
        tangents_from_pixel(other, xy), tangents_from_pixel(rectangular, xy), atol=1e-12
    )


@pytest.mark.slow  # the whole survey, 5 s
@pytest.mark.skipif(not SHARED.is_dir(), reason="reference data camcal is not beside the repository")
def test_camcal_export_gives_the_report_of_dbat(tmp_path: Path) -> None:
    """Convert alone, then adjust: the printed digits of camcal-dbatreport.txt."""
    convert(
        *(SHARED / "camcal-pmexport.txt", tmp_path / "t"),
        from_format="photomodeler",
        control=SHARED / "camcal-fixed.txt",
    )
    a = run_survey(read_survey(tmp_path / "t" / "survey.toml")).adjustment
    assert (round(a.sigma0, 4), a.redundancy) == (1.6148, 3725)
    values = dict(zip(a.estimate.cameras[0].names, a.estimate.cameras[0].parameters, strict=True))
    for name, value in (("K1", "0.00458861"), ("K2", "-4.51351e-05"), ("K3", "-2.05253e-06")):
        assert f"{values[name]:.6g}" == value
    for name, value in (
        ("c", "7.457"),
        ("P1", "-6.12803e-05"),
        ("P2", "-4.41172e-05"),
        ("b1", "0.000389598"),
    ):
        assert f"{values[name]:.6g}" == value


@pytest.mark.parametrize("lines", range(1, 30))
def test_truncated_file_is_refused_with_the_line(lines: int, tmp_path: Path) -> None:
    text = "\n".join(EXPORT.splitlines()[:lines])
    with pytest.raises(SurveyFileError, match=r"export\.txt, line \d+: "):
        read_photomodeler(write(tmp_path, text))


def test_missing_file_is_refused(tmp_path: Path) -> None:
    with pytest.raises(SurveyFileError, match="cannot be read"):
        read_photomodeler(tmp_path / "none.txt")


@pytest.mark.skipif(not SHARED.is_dir(), reason="reference data camcal is not beside the repository")
def test_camcal_export_projects_onto_its_own_marks() -> None:
    network, estimate = read_photomodeler(SHARED / "camcal-pmexport.txt", control=SHARED / "camcal-fixed.txt")
    seen = network.image_points
    assert (len(network.images), len(network.points), len(seen)) == (21, 100, 2074)
    assert [network.points[j] for j in network.control.point] == ["1001", "1002", "1003", "1004"]
    v = np.concatenate(
        [
            project(
                estimate.cameras[0], estimate.position[i], estimate.rotation[i], estimate.points[seen.point]
            )[seen.image == i]
            - seen.xy[seen.image == i]
            for i in range(21)
        ]
    )
    # The export rounds K2 to one digit and angles to 1e-3 deg; a wrong sign or origin would show as 50 px.
    assert np.sqrt((v**2).mean()) < 2.0
    assert np.abs(v.mean(axis=0)).max() < 0.3


def test_smart_points_have_the_precision_of_points_marked_by_hand(tmp_path: Path) -> None:
    """Their sigma is 0 in the export: they were weighted with 0.1 px after `convert`, marks with 1 px."""
    text = EXPORT.replace(" 1.00000  0.10000 10.00000", " 0.70000  0.10000 10.00000")
    network, _ = read_photomodeler(write(tmp_path, text))
    assert network.image_points.stated_sigma.tolist() == [[0.1, 0.2], [0.1, 0.1], [0.7, 0.7], [0.1, 0.1]]
    none = re.sub(r"( +0\.[12]0000){2}\n", " 0.00000  0.00000\n", EXPORT)
    network, _ = read_photomodeler(write(tmp_path, none))
    assert np.isnan(network.image_points.stated_sigma).all()  # as it came: nothing is stated


def _with_control(tmp_path: Path) -> tuple[Path, Network, Estimate]:
    """Write an export with weighted control and half of its image points without a standard deviation."""
    rng = seed_of("smart points")
    network, truth = make_network(rng, images=6, points=40, model="brown", noise_px=1.0, free=())
    seen = network.image_points
    stated = np.arange(len(seen)) % 2 == 0
    control = ObjectPoints(
        np.arange(8),
        truth.points[:8] + 1e-3 * rng.standard_normal((8, 3)),
        np.tile(1e-6 * np.eye(3), (8, 1, 1)),
    )
    points = tuple(str(j + 1) for j in range(40))
    network = replace(network, points=points, image_points=replace(seen, stated=stated)).with_given(control)
    lens = truth.cameras[0]
    values = tuple((n, v) for n, v in zip(lens.names, lens.parameters.tolist(), strict=True) if n != "b1")
    square = float(lens.pixel_mm[0])
    camera = camera_from_values(
        lens.name, "brown_dbat", lens.size_px, (square, square), c_mm=lens.value("c"), values=values
    )
    truth = replace(truth, cameras=(camera,))
    network = observed_anew(network, truth, 1.0, rng)
    path = tmp_path / "export.txt"
    write_export(path, Content(Solution("smart", network, truth)))
    return path, network, truth


def test_converted_weights_are_those_of_the_export(tmp_path: Path) -> None:
    """sigma0 is that of the adjustment with all standard deviations as stated, 10 times as large before."""
    path, network, truth = _with_control(tmp_path)
    convert(path, tmp_path / "tables", "tables")
    survey = read_survey(tmp_path / "tables" / "survey.toml")
    assert survey.adjust.weights == "stated"
    result = run_survey(survey)
    expected = adjust(network, truth, reject="none", datum=Datum("control"))
    assert result.adjustment.sigma0 == pytest.approx(expected.sigma0, rel=1e-6)
    assert 0.9 < result.adjustment.sigma0 < 1.1
    index = [network.points.index(name) for name in result.network.points]
    np.testing.assert_allclose(result.estimate.points, expected.estimate.points[index], atol=1e-7)


def test_a_held_camera_keeps_the_distortion_of_its_table(tmp_path: Path) -> None:
    """`free = []` written into a converted survey file set K1 to 0, in silence."""
    network, truth = make_network(seed_of("held camera"), images=6, points=40, model="brown")
    write_any(tmp_path / "tables", "tables", network, truth)
    file = tmp_path / "tables" / "survey.toml"
    text = file.read_text(encoding="utf-8")
    file.write_text(re.sub(r"^free = \[.+\]", "free = []", text, flags=re.MULTILINE), encoding="utf-8")
    (camera,) = run_survey(read_survey(file)).estimate.cameras
    assert not camera.free.any()
    np.testing.assert_allclose(camera.parameters, truth.cameras[0].parameters, rtol=1e-12)
