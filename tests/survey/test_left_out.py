"""Observations are adjusted as they are; what cannot be used or cannot be right is counted and named."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from sfm.judgement.survey_result import SurveyResult
from sfm.model.camera import project
from sfm.model.conventions import image_from_pixel
from sfm.model.errors import SurveyFileError
from sfm.model.estimate import Estimate
from sfm.model.network import ImagePoints, Network
from sfm.model.remarks.remark import kinds_of, of_kind
from sfm.model.similarity import fit_similarity
from sfm.pipeline import run_survey
from sfm.report.output import write_result
from sfm.survey.adjusting.settling import datum_carriers
from sfm.survey.inputs.survey import read_survey
from sfm.survey.sources.given import MARGIN_PX, MAX_OUTSIDE, measure_given, outside_photograph
from tests.findings import findings_of
from tests.surveys import survey_of, write_observed_survey
from tests.synthetic import PIXEL_MM, SIZE_PX, add_narrow_points, make_network, observed_anew, seed_of
from tests.tables import rows_of


@pytest.mark.parametrize("given", [False, True])
def test_two_ray_points_at_small_angles_take_part_with_their_true_sigma(given: bool) -> None:
    rng = seed_of("narrow")
    network, truth = add_narrow_points(*make_network(rng, images=8, points=60), rng, 12)
    result = run_survey(survey_of(network, truth, start=truth if given else None))
    assert set(result.network.points) == set(network.points)
    assert result.left_out == () and result.unused_image_points == 0
    assert len(result.network.image_points) == len(network.image_points)
    normalised = _normalised_errors(result, network, truth)
    narrow = np.array([name.startswith("w") for name in result.network.points])
    sigma = np.sqrt(np.trace(result.adjustment.covariance.points, axis1=1, axis2=2))
    assert sigma[narrow].min() > 5 * np.median(sigma[~narrow])
    for rows in (narrow, ~narrow):  # mean square 1 within three standard deviations of it
        assert np.mean(normalised[rows] ** 2) == pytest.approx(1, abs=3 * np.sqrt(2 / (3 * rows.sum())))
    assert result.adjustment.datum_points is not None  # they do not carry the datum
    assert not result.adjustment.datum_points[narrow].any()


def _normalised_errors(result: SurveyResult, network: Network, truth: Estimate) -> np.ndarray:
    """Errors of coordinates over their standard deviations after a fit on the well-determined points."""
    index = [network.point_index(name) for name in result.network.points]
    good = np.array([not name.startswith("w") for name in result.network.points])
    placing = fit_similarity(result.estimate.points[good], truth.points[index][good])
    error = placing.apply(result.estimate.points) - truth.points[index]
    variance = np.einsum(
        "ab,nbc,dc->nad", placing.rotation, result.adjustment.covariance.points, placing.rotation
    )
    return np.asarray(error / np.sqrt(np.diagonal(variance, axis1=1, axis2=2)) / placing.scale)


def _with_contradicting_points(name: str) -> tuple[Network, Estimate, list[str]]:
    """A network of which eight three-ray points have two wrong rays each, and two two-ray points miss."""
    rng = seed_of(name)
    network, truth = make_network(rng, images=10, points=80, visibility=0.3)
    seen, rays = network.image_points, network.rays()
    xy, keep = seen.xy.copy(), np.ones(len(seen), dtype=bool)
    wrong = np.flatnonzero(rays == 3)[:10]
    for number, j in enumerate(wrong):
        own = np.flatnonzero(seen.point == j)
        xy[own[:2]] += rng.choice([-1, 1], (2, 2)) * rng.uniform(20, 120, (2, 2))
        keep[own[2]] = number < 8
    points = replace(seen, xy=xy).select(keep)
    return replace(network, image_points=points), truth, [network.points[j] for j in wrong]


def test_rays_that_do_not_meet_are_adjusted_as_they_are() -> None:
    network, truth, wrong = _with_contradicting_points("vanish")
    result = run_survey(survey_of(network, truth, adjust={"reject": "none"}))
    assert set(wrong) <= set(result.network.points)
    assert len(result.adjustment.rejected) == len(network.image_points) and result.left_out == ()
    assert findings_of(result).verdict.level == "bad"  # and their residuals say so


def test_what_is_left_out_is_counted_and_named_everywhere(tmp_path: Path) -> None:
    network, truth, wrong = _with_contradicting_points("vanish")
    result = run_survey(survey_of(network, truth, adjust={"reject": "tau"}))
    left = {one.point: one for one in result.left_out}
    assert left and set(left) <= set(wrong)
    assert set(result.network.points) | set(left) == set(network.points)
    assert len(result.adjustment.rejected) + result.unused_image_points == len(network.image_points)
    assert all(one.reason.kind == "points_contradicted" for one in left.values())
    findings = findings_of(result)
    (lost,) = of_kind(result.remarks, "points_contradicted")
    assert set(lost.names("points")) == set(left) and lost.number("measured") == 80
    folder = tmp_path / "out"
    write_result(findings, folder)
    stored = json.loads((folder / "summary.json").read_text(encoding="utf-8"))
    assert stored["observations"]["not_in_result"] == result.unused_image_points
    assert {one["point"] for one in stored["left_out"]} == set(left)
    rows = rows_of(folder / "left_out.csv")
    assert {row["name"] for row in rows} == set(left)
    assert sum(int(row["image_points"]) for row in rows) == result.unused_image_points
    counts = f"{result.unused_image_points} not in the result (of {len(left)} points)"
    for name in ("report.txt", "report.html"):
        page = (folder / name).read_text(encoding="utf-8")
        assert "not in the result" in page and all(one.reason.text in page for one in left.values()), name
    assert counts in (folder / "report.txt").read_text(encoding="utf-8")


def test_rays_parallel_within_their_precision_are_named() -> None:
    rng = seed_of("parallel")
    network, truth = add_narrow_points(*make_network(rng, images=8, points=60), rng, 3, noise_px=0.1)
    # the same direction in both photographs: points at infinity
    seen = network.image_points
    xy = seen.xy.copy()
    for j in range(60, 63):
        first, second = np.flatnonzero(seen.point == j)
        xy[second] = xy[first] + 0.05 * rng.standard_normal(2)
    network = replace(network, image_points=replace(seen, xy=xy))
    result = run_survey(survey_of(network, truth, adjust={"reject": "none"}))
    assert result.adjustment.converged and len(result.network.points) == 60
    assert {one.point for one in result.left_out} == {"w1", "w2", "w3"}
    for one in result.left_out:
        assert one.reason.kind in ("points_not_determined", "points_contradicted")


def test_carriers_of_a_datum_are_those_whose_rays_meet_clearly() -> None:
    carriers = datum_carriers(np.array([50.0, 1.0, 30.0, np.nan]), 2.0)
    assert carriers is not None and carriers.tolist() == [True, False, True, True]
    assert datum_carriers(np.array([50.0, 40.0]), 2.0) is None
    assert datum_carriers(np.array([0.5, 0.4, 1.0, 50.0]), 2.0) is None  # all that there is


NOISE_PX = 0.1


def network_with_far_points(number: int, count: int, distance: float) -> tuple[Network, Estimate]:
    """Return photographs from above of 30 points, and of points so far below them, in units of the object."""
    rng = seed_of(f"far points {number}")
    network, truth = make_network(rng, points=30, planar=True)
    relief = rng.uniform(-0.2, 0.2, (30, 1)) * [0, 0, 1]
    truth = replace(truth, points=truth.points + relief)
    network = observed_anew(network, truth, NOISE_PX, rng)
    sideways = rng.uniform(-0.2, 0.2, (count, 2))
    far = distance * np.column_stack([sideways, -np.ones(count)])
    seen, rows = network.image_points, []
    for i in range(len(network.images)):
        xy = project(truth.cameras[0], truth.position[i], truth.rotation[i], far)
        inside = ((xy > 0) & (xy < np.array(SIZE_PX) - 1)).all(axis=1)
        rows += [(i, 30 + j, *(xy[j] + NOISE_PX * rng.standard_normal(2))) for j in np.flatnonzero(inside)]
    image, point, x, y = np.array(rows).T
    both = ImagePoints(
        np.concatenate([seen.image, image.astype(np.int64)]),
        np.concatenate([seen.point, point.astype(np.int64)]),
        np.concatenate([seen.xy, np.column_stack([x, y])]),
        np.concatenate([seen.covariance, np.tile(seen.covariance[:1], (len(rows), 1, 1))]),
    )
    names = (*network.points, *(f"far {k + 1}" for k in range(count)))
    return (
        replace(network, points=names, image_points=both),
        replace(truth, points=np.vstack([truth.points, far])),
    )


@pytest.mark.sweep(1)
@pytest.mark.parametrize(
    ("count", "distance"),
    [
        (1, 1e4),
        (4, 1e7),
        *(pytest.param(*case, marks=pytest.mark.slow) for case in ((4, 1e4), (8, 1e4), (1, 1e5), (4, 1e5))),
        *(pytest.param(*case, marks=pytest.mark.slow) for case in ((8, 1e5), (1, 1e7), (8, 1e7))),
    ],
)
def test_far_points_are_left_out_by_name(count: int, distance: float) -> None:
    for number in range(3):
        network, truth = network_with_far_points(number, count, distance)
        result = run_survey(survey_of(network, truth))
        assert len(result.network.images) == len(network.images) and result.adjustment.converged
        assert set(result.network.points) == set(network.points[:30])
        measured = {network.points[j] for j in np.flatnonzero(network.rays())}
        assert {one.point for one in result.left_out} == measured - set(network.points[:30])
        assert {one.reason.kind for one in result.left_out} <= {
            "points_not_determined",
            "points_contradicted",
        }


def test_points_at_a_distance_that_is_measured_stay() -> None:
    """A hundred object sizes away they have a parallax of some 60 px."""
    network, truth = network_with_far_points(0, 3, 100.0)
    seen = network.rays()[30:] >= 2
    result = run_survey(survey_of(network, truth))
    assert seen.any() and {network.points[30 + j] for j in np.flatnonzero(seen)} <= set(result.network.points)


Rows = list[list[str]]


def rewritten(folder: Path, change: Callable[[Rows], Rows], **settings: str) -> Path:
    """Write a survey of 20 points in 6 photographs, with its table and its settings changed."""
    path = write_observed_survey(folder / "s", "implausible")
    table = path.parent / "image_points.csv"
    header, *lines = table.read_text(encoding="utf-8").splitlines()
    rows = change([line.split(",") for line in lines])
    table.write_text("\n".join((header, *map(",".join, rows))) + "\n", encoding="utf-8")
    text = path.read_text(encoding="utf-8")
    for key, value in settings.items():
        (old,) = [line for line in text.splitlines() if line.startswith(f"{key} = ")]
        text = text.replace(old, f"{key} = {value}")
    path.write_text(text, encoding="utf-8")
    return path


def spread(rows: Rows) -> Rows:
    """Return the rows with points up to all borders of the photographs."""
    corners = [(0.0, 0.0), (SIZE_PX[0] - 1.0, 0.0), (SIZE_PX[0] - 1.0, SIZE_PX[1] - 1.0)]
    places = np.linspace(0, 1, len(rows))
    out = []
    for k, (image, point, _, _) in enumerate(rows):
        x, y = corners[k] if k < 3 else (places[k] * (SIZE_PX[0] - 1), places[-k] * (SIZE_PX[1] - 1))
        out.append([image, point, repr(float(x)), repr(float(y))])
    return out


def refused(path: Path, match: str) -> None:
    with pytest.raises(SurveyFileError, match=match) as error:
        measure_given(read_survey(path))
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("change", "settings", "match"),
    [
        (lambda rows: [[i, p, y, x] for i, p, x, y in spread(rows)], {}, "with x and y exchanged"),
        (spread, {"size_px": f"[{SIZE_PX[1]}, {SIZE_PX[0]}]"}, "with x and y exchanged"),
        (
            spread,
            {"size_px": f"[{SIZE_PX[0] // 2}, {SIZE_PX[1] // 2}]"},
            f"size_px must be {SIZE_PX[0] - 1} x {SIZE_PX[1] - 1} or",
        ),
        (list, {"pixel_mm": "[5, 5]"}, "expected 0.5 to 170; .*pixel_mm in µm"),
        (list, {"c_mm": "0.024"}, "expected 0.5 to 170; .*c_mm in m"),
        (list, {"c_mm": "24000.0"}, "expected 0.5 to 170; .*c_mm in µm"),
        (list, {"pixel_mm": "[5e-6, 5e-6]"}, "expected 0.5 to 170; .*pixel_mm in m"),
    ],
)
def test_what_cannot_be_right_is_refused_with_the_likely_reason(
    tmp_path: Path, change: Callable[[Rows], Rows], settings: dict[str, str], match: str
) -> None:
    refused(rewritten(tmp_path, change, **settings), match)


def test_another_unit_is_named(tmp_path: Path) -> None:
    def in_mm(rows: Rows) -> Rows:
        xy = np.array([[float(x), float(y)] for *_, x, y in rows])
        mm = image_from_pixel(xy, SIZE_PX, np.array(PIXEL_MM))
        return [[*row[:2], repr(x), repr(y)] for row, (x, y) in zip(rows, mm.tolist(), strict=True)]

    refused(rewritten(tmp_path, in_mm), "read as mm in place of px")
    path = rewritten(tmp_path / "px", lambda rows: rows)
    table = path.parent / "image_points.csv"
    table.write_text(table.read_text().replace("x_px,y_px", "x_mm,y_mm"), encoding="utf-8")
    refused(path, "read as px in place of mm")


def test_single_points_outside_are_left_out_by_name(tmp_path: Path) -> None:
    found = measure_given(
        read_survey(rewritten(tmp_path, lambda rows: [*rows, ["image 1", "new", "250000", "12"]]))
    )
    assert kinds_of(found.remarks) == ("image_points_outside",)
    assert found.remarks[0].names("image_points") == ("new in image 1",)
    assert [one.point for one in found.left_out] == ["new in image 1"]
    assert len(found.network.image_points) == len(found.network.image_points.xy) > 100


@pytest.mark.parametrize(("share", "is_refused"), [(0.5, False), (2.0, True)])
def test_the_share_of_gross_errors_that_is_left_out(tmp_path: Path, share: float, is_refused: bool) -> None:
    def change(rows: Rows) -> Rows:
        count = int(share * MAX_OUTSIDE * len(rows))
        return [[*row[:2], "-40", row[3]] if k < count else row for k, row in enumerate(rows)]

    path = rewritten(tmp_path, change)
    if is_refused:
        refused(path, "is outside its photograph")
    else:
        assert measure_given(read_survey(path)).left_out


def test_the_border_of_the_photograph() -> None:
    size = np.tile([100.0, 50.0], (4, 1))
    inside = np.array([[-0.5, 0.0], [99.5, 49.5], [-0.5 - MARGIN_PX, 3], [99.5 + MARGIN_PX, 3]])
    assert not outside_photograph(inside, size).any() and MARGIN_PX == 1.0
    assert outside_photograph(inside + np.array([[-1.1, 0], [0, 1.1], [-0.1, 0], [0.1, 0]]), size).all()


@pytest.mark.parametrize(("c_mm", "is_refused"), [(0.4, True), (0.8, False), (1100.0, False), (2000.0, True)])
def test_the_limits_of_the_field_of_view(tmp_path: Path, c_mm: float, is_refused: bool) -> None:
    """12.5 mm of a diagonal: 170 degrees at 0.55 mm, 0.5 degrees at 1432 mm."""
    path = rewritten(tmp_path, lambda rows: rows, c_mm=repr(c_mm))
    if is_refused:
        refused(path, "field of view")
    else:
        measure_given(read_survey(path))
