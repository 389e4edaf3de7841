"""Planning: the size of targets by the formula of document 000 and as a renderer sees it."""

import re
import subprocess
import sys
from xml.etree import ElementTree

import numpy as np
import pytest

from sfm.camera import camera_from_values, project
from sfm.errors import GeometryError
from sfm.planning.visibility import compute_target_size
from sfm.report.figures.comparisons import DIAGRAM_PIXELS, design_diagram


def test_formula_of_document_000() -> None:
    # 7 px with the document's Nikon D60 (23.6 mm, 3872 px) and 18 mm: a line through the origin
    size = compute_target_size(p=7, w_mm=23.6, d=5000.0, c_mm=18.0, n=3872)
    assert size.diameter == pytest.approx(7 * 23.6 * 5000 / (18 * 3872), abs=1e-12)
    assert size.diameter == pytest.approx(11.85, abs=0.01)
    assert size.ring == pytest.approx(3 * size.diameter)
    assert compute_target_size(p=7, w_mm=23.6, d=10.0, c_mm=18.0, n=3872).diameter == pytest.approx(
        0.0237, abs=1e-4
    )


@pytest.mark.parametrize("tilt", [0.0, 60.0])
def test_a_target_of_that_size_shows_that_many_pixels(tilt: float) -> None:
    size = compute_target_size(p=12, w_mm=36.0, d=3000.0, c_mm=28.0, n=6000, tilt_deg=tilt)
    camera = camera_from_values("c", "brown", (6000, 4000), (0.006, 0.006), c_mm=28.0)
    t = np.linspace(0, 2 * np.pi, 721)
    r, slope = size.diameter / 2, np.radians(tilt)
    rim = r * np.column_stack([np.cos(t), np.sin(t) * np.cos(slope), np.sin(t) * np.sin(slope)])
    xy = project(camera, np.array([0.0, 0.0, 3000.0]), np.eye(3), rim)
    across = np.ptp(xy, axis=0)
    assert across.min() == pytest.approx(12, rel=1e-3)
    assert across.max() == pytest.approx(12 / np.cos(slope), rel=1e-3)


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"d": 0.0}, "distance is 0"),
        ({"c_mm": float("nan")}, "principal distance is nan"),
        ({"tilt_deg": 80.0}, "tilt is 80 deg, needed 0 to 75"),
    ],
)
def test_nonsense_is_refused(wrong: dict[str, float], message: str) -> None:
    given = {"p": 7, "w_mm": 36.0, "d": 1000.0, "c_mm": 24.0, "n": 6000} | wrong
    with pytest.raises(GeometryError, match=message):
        compute_target_size(**given)


def test_command() -> None:
    camera = ["--c-mm", "18", "--sensor-width-mm", "23.6", "--width-px", "3872"]
    words = ["plan", "target-size", "--distance", "5", "--unit", "m", *camera]
    done = subprocess.run(
        [sys.executable, "-c", "from sfm.cli import main; main()", *words], capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr
    assert "0.01185 m, 7 px across" in done.stdout
    assert "0.03555 m outer diameter (ring14)" in done.stdout
    bad = [*words[:-1], "0"]
    done = subprocess.run(
        [sys.executable, "-c", "from sfm.cli import main; main()", *bad], capture_output=True, text=True
    )
    assert done.returncode == 2
    assert done.stderr.strip() == "kolinear: target size: photograph is 0, needed more than 0"
    bad = [*words[:5], "furlong", *camera]
    done = subprocess.run(
        [sys.executable, "-c", "from sfm.cli import main; main()", *bad], capture_output=True, text=True
    )
    assert done.returncode == 2
    assert (
        done.stderr.strip()
        == "kolinear: --unit furlong: expected one of km, m, dm, cm, mm, um, µm, nm, in, ft"
    )


def test_the_design_diagram_ends_at_the_diameters_of_the_farthest_distance() -> None:
    """Document 000, fig. 2.11: 7 px of a Nikon D60 at 18 mm; 23.6 mm x 7 / (18 mm x 3872) = 2.37 mm per m."""
    given = {"w_mm": 23.6, "d": 10.0, "c_mm": 18.0, "n": 3872}
    assert 1000 * compute_target_size(p=7, **given).diameter == pytest.approx(23.703, abs=5e-4)
    root = ElementTree.fromstring(design_diagram(unit="m", **given))
    path = "{http://www.w3.org/2000/svg}path"
    ends = {}
    for pixels in DIAGRAM_PIXELS:
        (line,) = root.findall(f".//*[@id='{pixels:g} px']/{path}")
        x0, y0, x1, y1 = map(float, re.findall(r"[\d.]+", line.attrib["d"]))
        ends[pixels] = x0, y0, x1, y0 - y1
    assert len({one[:3] for one in ends.values()}) == 1
    for pixels, end in ends.items():  # lengths in the picture are in proportion to the diameters
        assert end[3] / ends[7.0][3] == pytest.approx(pixels / 7, rel=1e-4)
    with pytest.raises(GeometryError):
        design_diagram(unit="m", w_mm=23.6, d=-1.0, c_mm=18.0, n=3872)
