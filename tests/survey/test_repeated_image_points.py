"""Repeated image points are merged, averaged or left out by what they say; sigmas are not invented."""

from __future__ import annotations

import csv
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from adapters.formats.photomodeler import read_photomodeler, write_photomodeler
from adapters.formats.result_tables import write_tables
from sfm.network import ImagePoints, Network
from sfm.pipeline import run_survey
from sfm.remarks.remark import of_kind
from sfm.report.findings.survey_remarks import findings_of
from sfm.report.tables.csv_files import write_tables as write_result_tables
from sfm.solution import Solution
from sfm.survey.inputs.given import read_image_points
from sfm.survey.inputs.start import merge_repeated
from tests.surveys import survey_of
from tests.synthetic import make_network, seed_of


def _repeated(network: Network, rows: list[int], offsets_px: list[float]) -> Network:
    """The network with some image points again, moved by so much in x."""
    seen = network.image_points
    again = seen.select(np.array(rows))
    moved = again.xy + np.array(offsets_px)[:, None] * (1, 0)
    both = ImagePoints(
        np.concatenate([seen.image, again.image]),
        np.concatenate([seen.point, again.point]),
        np.concatenate([seen.xy, moved]),
        np.concatenate([seen.covariance, again.covariance]),
    )
    return replace(network, image_points=both)


def test_repeated_image_points_do_not_refuse_a_survey() -> None:
    network, truth = make_network(seed_of("repeated"), images=6, points=20)
    result = run_survey(survey_of(_repeated(network, [3, 20, 40], [0.0, 0.15, 5.0]), truth))
    rows, (image, point) = len(network.image_points), (network.image_points.image, network.image_points.point)
    assert len(result.adjustment.rejected) == rows - 1 and result.unused_image_points == 2
    for k, kind in ((3, "identical"), (20, "averaged"), (40, "contradicting")):
        name = f"{network.points[point[k]]} in {network.images[image[k]]}"
        (found,) = of_kind(result.remarks, f"image_points_{kind}")
        assert found.names("image_points") == (name,)
    (left,) = result.left_out
    assert (
        left.point == f"{network.points[point[40]]} in {network.images[image[40]]}" and left.image_points == 2
    )


def test_the_mean_of_two_has_the_weight_of_both() -> None:
    network, _ = make_network(seed_of("mean"), images=4, points=10)
    merged = merge_repeated(_repeated(network, [5], [0.2]).image_points)
    seen = network.image_points
    assert merged.averaged == ((int(seen.image[5]), int(seen.point[5])),)
    np.testing.assert_allclose(merged.image_points.xy[5], seen.xy[5] + (0.1, 0))
    np.testing.assert_allclose(merged.image_points.covariance[5], seen.covariance[5] / 2)
    assert len(merged.image_points) == len(seen)


def test_chance_is_no_contradiction() -> None:
    rng = seed_of("chance")
    n, sigma = 4000, 0.3
    twice = ImagePoints(
        np.zeros(2 * n, dtype=np.int64),
        np.tile(np.arange(n), 2),
        sigma * rng.standard_normal((2 * n, 2)),
        np.tile(sigma**2 * np.eye(2), (2 * n, 1, 1)),
    )
    merged = merge_repeated(twice)
    assert len(merged.dropped) <= 12  # 4 expected at 0.1 %
    assert merged.dropped_rows == 2 * len(merged.dropped)


def test_a_photomodeler_export_with_repeated_points_is_read(tmp_path: Path) -> None:
    network, truth = make_network(seed_of("export"), images=4, points=12, model="brown")
    plain = replace(truth, cameras=(truth.cameras[0].with_parameters(_without_affinity(truth.cameras[0])),))
    write_photomodeler(tmp_path / "a.txt", _repeated(network, [2, 7], [0.0, 3.0]), plain)
    read, _ = read_photomodeler(tmp_path / "a.txt")
    assert (
        len(read.image_points) == len(network.image_points) + 1
    )  # the contradicting one stays for judgement


def _without_affinity(camera: object) -> np.ndarray:
    names, p = camera.names, camera.parameters.copy()  # type: ignore[attr-defined]
    for name in ("b1", "b2"):
        p[names.index(name)] = 0.0
    return np.asarray(p)


def test_no_sigma_is_invented_in_the_tables(tmp_path: Path) -> None:
    network, truth = make_network(seed_of("no sigma"), images=5, points=15)
    seen = network.image_points
    unknown = replace(network, image_points=replace(seen, stated=np.zeros(len(seen), dtype=bool)))
    write_tables(tmp_path / "tables", Solution("x", unknown, truth))
    header = (tmp_path / "tables" / "image_points.csv").read_text("utf-8").splitlines()[0]
    assert header == "image,point,x_px,y_px"
    assert read_image_points(tmp_path / "tables" / "image_points.csv").sigma is None
    # and a result of image points without sigmas leaves the cells empty, so that another sigma_px holds
    result = run_survey(survey_of(network, truth, adjust={"sigma_px": 0.25}))
    (tmp_path / "result").mkdir()
    write_result_tables(findings_of(result), tmp_path / "result")
    with (tmp_path / "result" / "image_points.csv").open(encoding="utf-8") as file:
        assert all(row["sx_px"] == row["sy_px"] == "" for row in csv.DictReader(file))
    again = replace(survey_of(network, truth), observations=read_image_points(file_of(tmp_path)))
    assert run_survey(again).adjustment.stated_px == pytest.approx(0.1)


def file_of(folder: Path) -> Path:
    return folder / "result" / "image_points.csv"


def test_stated_sigmas_come_back(tmp_path: Path) -> None:
    network, truth = make_network(seed_of("sigma"), images=5, points=15, noise_px=0.2)
    result = run_survey(survey_of(network, truth, sigma=True))
    write_result_tables(findings_of(result), tmp_path)
    found = read_image_points(tmp_path / "image_points.csv")
    assert found.sigma is not None
    np.testing.assert_allclose(found.sigma, 0.2)


def test_repeated_image_points_are_looked_up_once(monkeypatch: pytest.MonkeyPatch) -> None:
    network, _ = make_network(seed_of("many repeated"), images=3, points=200)
    seen = _repeated(network, list(range(500)), [0.0] * 500).image_points
    looked = 0

    def counted(values: np.ndarray, real: Any = np.flatnonzero) -> np.ndarray:
        nonlocal looked
        looked += len(values)
        return real(values)

    monkeypatch.setattr(np, "flatnonzero", counted)
    assert len(merge_repeated(seen).same) == 500
    assert looked <= len(seen)  # not once for each of them
