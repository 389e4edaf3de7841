"""PhotoModeler export: origin, angles, units, and refusals that name the line."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from adapters.formats.photomodeler import read_photomodeler
from sfm.camera import project
from sfm.conventions import angles_from_rotation
from sfm.errors import SurveyFileError
from tests.places import SHARED

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
    assert dict(zip(camera.names, camera.free, strict=True)) == {
        **dict.fromkeys(camera.names, True),
        "b2": False,
    }
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
        ("   1       12", "   5       12", "line 28: photograph 5, there are 0 to 1"),
        ("       9    0.00000", "       8    0.00000", "line 23: point 8 is a duplicate"),
        ("  0.10000  0.20000\n", "  0.10000\n", "line 25: 5 numbers, needed 6"),
    ],
)
def test_bad_lines_are_named(old: str, new: str, message: str, tmp_path: Path) -> None:
    assert old in EXPORT
    with pytest.raises(SurveyFileError, match=f"export.txt, {message}"):
        read_photomodeler(write(tmp_path, EXPORT.replace(old, new, 1)))


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
