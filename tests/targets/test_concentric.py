"""Concentric circle tags: ids, the image of the common centre with its sigma, and what must not be read."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import cv2
import numpy as np
import pytest

from sfm.model.conventions import AnyArray, FloatArray
from sfm.model.errors import GeometryError
from sfm.targets.codes.concentric import WIDTHS, ConcentricFamily, concentric_family
from sfm.targets.codes.plates import code_family
from sfm.targets.detect import find_targets
from sfm.targets.outlines import Flag
from tests.synthetic import seed_of
from tests.targets.concentric_tags import Tag, draw_tag, read_tags

# Radii of some tags as published with alicevision/CCTag (markersToPrint/generators), percent.
PUBLISHED = {
    "cctag3": {
        0: (90, 80, 70, 60, 50),
        1: (90, 80, 70, 60, 45),
        15: (90, 75, 60, 45, 30),
        16: (85, 75, 65, 55, 45),
        31: (85, 70, 55, 40, 25),
    },
    "cctag4": {
        0: (92, 84, 76, 68, 60, 52, 44),
        63: (92, 80, 68, 56, 44, 32, 20),
        64: (88, 80, 72, 64, 56, 48, 40),
        127: (88, 76, 64, 52, 40, 28, 16),
    },
}


@pytest.mark.parametrize("name", WIDTHS)
def test_radii_are_the_published_ones(name: str) -> None:
    family = concentric_family(name)
    assert code_family(name) == family
    for number, radii in PUBLISHED[name].items():
        assert 100 * family.radii(number) == pytest.approx([100, *radii])
    assert family.count == {"cctag3": 32, "cctag4": 128}[name]
    with pytest.raises(GeometryError):
        family.radii(family.count)


def drawn(name: str, count: int, radius: float, **options: float) -> list[Tag]:
    family, rng = concentric_family(name), seed_of(f"{name} {radius} {options}")
    settings = {"tilt_deg": 45.0, "blur": 0.8, "noise": 2.0} | options
    numbers = rng.integers(family.count, size=count)
    return [draw_tag(family, int(n), radius, rng=rng, **settings) for n in numbers]


@pytest.mark.sweep(1, 2, 5)
@pytest.mark.parametrize(
    ("name", "radius", "options"),
    [
        ("cctag3", 15.0, {"tilt_deg": 30.0}),
        ("cctag3", 40.0, {"tilt_deg": 60.0, "blur": 1.5, "noise": 5.0}),
        ("cctag4", 30.0, {"tilt_deg": 60.0}),
        pytest.param("cctag3", 30.0, {"spread": 0.008}, marks=pytest.mark.slow),
        ("cctag4", 30.0, {"spread": -0.006, "slope": 0.5}),
        ("cctag3", 30.0, {"paper": 45.0, "ink": 200.0}),
        pytest.param("cctag3", 30.0, {"paper": 275.0}, marks=pytest.mark.slow),
    ],
)
def test_ids_and_centres(name: str, radius: float, options: dict[str, float]) -> None:
    read = read_tags(drawn(name, 6, radius, **options), name)
    assert (read.right, read.wrong) == (6, 0)
    assert np.sqrt(np.mean(read.normalised**2)) < 1.6  # 12 components: chi2 above 31 once in 500 times


@pytest.mark.slow
@pytest.mark.parametrize("name", WIDTHS)
def test_sigma_is_true_and_no_id_wrong(name: str) -> None:
    parts = [
        read_tags(drawn(name, 25, radius, tilt_deg=tilt, blur=blur, noise=noise), name)
        for radius in (20.0, 40.0, 60.0)
        for tilt in (0.0, 60.0)
        for blur, noise in ((0.7, 2.0), (1.0, 5.0))
    ]
    assert sum(part.wrong for part in parts) == 0
    assert sum(part.right for part in parts) > 200
    assert 0.9 < np.sqrt(np.mean(np.concatenate([part.normalised for part in parts]) ** 2)) < 1.2


class Disc(ConcentricFamily):
    """Tags without rings: dots."""

    def radii(self, number: int) -> FloatArray:
        return np.ones(1)


def test_the_point_is_the_image_of_the_centre_and_no_eccentric_one() -> None:
    (tag,) = drawn("cctag3", 1, 60.0, tilt_deg=60.0)
    found = find_targets(tag.image, codes="cctag3")
    assert len(found) == 1 and found.code[0] == tag.number  # its rings and its disc are no targets
    assert np.hypot(*(found.xy[0] - tag.truth)) < 0.03
    assert found.flag[0] & Flag.CONCENTRIC
    assert found.semi_axes[0, 0] == pytest.approx(60, rel=0.05)
    assert found.confidence[0] > 0.8 and found.polarity[0] == -1
    disc = Disc("disc", 0, 0.0, 0.0)
    dot = draw_tag(disc, 0, 60.0, tilt_deg=60.0, blur=0.8, noise=2.0, rng=seed_of("dot"))
    assert np.hypot(*(find_targets(dot.image).xy[0] - dot.truth)) > 1.0  # px: there is an eccentricity


def moved_edge(family: ConcentricFamily, number: int, edge: int, by: float) -> ConcentricFamily:
    """Return a family whose tags all have the radii of one, an edge of which is moved by a part of a bit."""

    class Moved(ConcentricFamily):
        def radii(self, number_of_any: int) -> FloatArray:
            radii = family.radii(number)
            radii[edge:] -= by * family.bit
            return radii

    return Moved(family.name, family.steps, family.narrow, family.bit)


@pytest.mark.parametrize(("by", "read"), [(0.15, True), (-0.15, True), (0.4, False), (0.5, False)])
def test_radii_between_two_codes_are_not_read(by: float, read: bool) -> None:
    rng = seed_of("between")
    between = moved_edge(concentric_family("cctag3"), 10, 3, by)  # step 3 is narrow, a bit wider is tag 14
    tag = draw_tag(between, 10, 40.0, tilt_deg=30.0, blur=0.8, noise=2.0, rng=rng)
    found = find_targets(tag.image, codes="cctag3")
    assert list(found.code[found.code >= 0]) == ([10] if read else [])


def test_other_rings_are_not_read() -> None:
    for tag in drawn("cctag4", 4, 40.0):
        assert (find_targets(tag.image, codes="cctag3").code < 0).all()
    for tag in drawn("cctag3", 4, 40.0):
        assert (find_targets(tag.image, codes="cctag4").code < 0).all()
    even = replace(concentric_family("cctag3"), narrow=0.18, bit=0.0)
    tag = draw_tag(even, 0, 40.0, tilt_deg=30.0, blur=0.8, noise=2.0, rng=seed_of("even"))
    assert (find_targets(tag.image, codes="cctag3").code < 0).all()


def test_a_covered_tag_is_not_measured() -> None:
    (tag,) = drawn("cctag3", 1, 40.0, tilt_deg=0.0)
    for share, kept in ((0.0, 1), (0.35, 0)):
        image = tag.image.copy()
        corners = tag.truth + 40 * np.array([[1 - 2 * share, -2], [2, -2], [2, 2], [1 - 2 * share, 2]])
        if share:
            cv2.fillPoly(image, [np.rint(corners).astype(np.int32)], 120)
        assert (find_targets(image, codes="cctag3").code >= 0).sum() == kept


@pytest.mark.parametrize(("part", "kept"), [(0.25, 1), (0.5, 0)])
def test_a_disc_on_the_rings_refuses_the_tag_from_some_size_on(part: float, kept: int) -> None:
    """Residuals of the sixteenth with the disc are 0.24 and 0.35 steps."""
    (tag,) = drawn("cctag3", 1, 40.0, tilt_deg=0.0)
    image, at = tag.image.copy(), np.rint(tag.truth + np.array([30, 0])).astype(int).tolist()
    cv2.circle(image, at, round(40 * part), 120, -1)
    assert (find_targets(image, codes="cctag3").code >= 0).sum() == kept


def test_unresolved_rings_are_not_read() -> None:
    read = read_tags(drawn("cctag4", 6, 12.0, blur=1.5, noise=5.0), "cctag4")
    assert (read.right, read.wrong) == (0, 0)


def test_a_tag_cut_by_the_border_is_left_out() -> None:
    (tag,) = drawn("cctag3", 1, 30.0)
    image = np.ascontiguousarray(tag.image[:, int(tag.truth[0]) - 25 :])
    assert (find_targets(image, codes="cctag3").code < 0).all()


def sharpened(image: AnyArray) -> AnyArray:
    """Return what a camera that sharpens much makes of a photograph."""
    grey = image.astype(float)
    return np.rint(grey + grey - cv2.GaussianBlur(grey, (0, 0), 1.5)).clip(0, 255).astype(np.uint8)


def compressed(image: AnyArray) -> AnyArray:
    """Return a photograph as JPEG of quality 75 gives it back."""
    coded = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, 75])[1]
    return np.asarray(cv2.imdecode(coded, cv2.IMREAD_GRAYSCALE))


# without sharpening in the model errors are 0.6 of the stated ones
@pytest.mark.parametrize("change", [sharpened, compressed])
@pytest.mark.slow
@pytest.mark.parametrize(("name", "radius"), [("cctag3", 25.0), ("cctag4", 30.0)])
def test_sharpening_and_compression_leave_ids_and_sigma_true(
    name: str, radius: float, change: Callable[[AnyArray], AnyArray]
) -> None:
    tags = [tag._replace(image=change(tag.image)) for tag in drawn(name, 20, radius, blur=1.0, tilt_deg=40.0)]
    read = read_tags(tags, name)
    over = np.sqrt(np.mean(read.normalised**2))
    print(f"{name}, {radius:g} px: RMS {np.sqrt(np.mean(read.error**2)):.4f} px, {over:.2f} of the stated")
    assert read.right == len(tags) and not read.wrong
    assert 0.75 < over < 1.35
