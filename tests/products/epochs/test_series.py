"""Three epochs of one object, from results to the page."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from sfm.adjustment.solve import adjust
from sfm.model.conventions import FloatArray
from sfm.model.errors import GeometryError
from sfm.model.remarks.remark import Remark, kinds_of
from sfm.products.epochs.differences import Epoch, epoch_differences
from sfm.products.epochs.displacements import find_displacements
from sfm.products.epochs.page import describe_stable
from sfm.products.epochs.series import EpochSeries, analyse_epochs, remarks_of_pair, verdict_of_epochs
from sfm.report.pages import write_page
from tests.products.epochs.scenes import POINTS, epoch
from tests.synthetic import make_network, seed_of
from tests.tables import rows_of


def shift(size: float) -> FloatArray:
    moved = np.zeros((POINTS, 3))
    moved[[4, 16, 21, 40]] = [0.0, 0.0, size]
    return moved


def epochs() -> tuple[Epoch, ...]:
    return epoch(70), epoch(71, shift(0.0)), epoch(72, shift(0.01))


def series() -> EpochSeries:
    return analyse_epochs(epochs(), groups={"span": ["5", "17", "22", "41"]})


def test_each_epoch_stands_against_the_first_and_the_one_before(tmp_path: Path) -> None:
    found = series()
    assert [pair.displacements.differences.names for pair in found.pairs] == [
        ("epoch 70", "epoch 71"),
        ("epoch 70", "epoch 72"),
        ("epoch 71", "epoch 72"),
    ]
    still, since_first, since_previous = found.pairs
    assert not still.displacements.changed
    for pair in (since_first, since_previous):
        assert np.flatnonzero(pair.displacements.moved).tolist() == [4, 16, 21, 40]
        (span,) = pair.groups
        assert span.moved and span.fits and pair.together is not None
        assert abs(span.value[2] - 0.01) < 4 * span.sigma[2]
    page = write_page(found, tmp_path / "out")
    assert {path.name for path in (tmp_path / "out").iterdir()} == {
        *("displacements.csv", "series.csv", "epochs.json", "epochs.html", "manifest.json")
    }
    text = page.read_text(encoding="utf-8")
    said = verdict_of_epochs(found).remarks[0].text
    assert said in text.replace("\xa0", " ") and "span" in text and "Series" in text
    rows = rows_of(tmp_path / "out/displacements.csv")
    assert len(rows) == 3 * POINTS and sum(int(row["moved"]) for row in rows) == 8
    summary = json.loads((tmp_path / "out/epochs.json").read_text(encoding="utf-8"))
    assert summary["changed"] and summary["pairs"][1]["moved"] == ["5", "17", "22", "41"]
    assert len(summary["pairs"][1]["steps"]) == 5


def test_words() -> None:
    still, moved, _ = (pair.displacements for pair in series().pairs)
    assert tuple(remarks_of_pair(still)) == ()
    assert describe_stable(still) == "All 60 reference points agree."
    (one,) = remarks_of_pair(moved)
    assert one.kind == "displaced" and one.names("points") == ("5", "17", "22", "41")
    assert abs(one.number("distance") - 0.01) < 1e-3 and one.number("tested") == 60
    assert verdict_of_epochs(series()).level == "fair"
    assert "56 of 60 reference points are proposed as stable" in describe_stable(moved)


def test_refusals_are_one_line() -> None:
    first, second, _ = epochs()
    with pytest.raises(GeometryError, match="1 given, expected 2 or more"):
        analyse_epochs([first])
    with pytest.raises(GeometryError, match="two of them are called 'epoch 70'"):
        analyse_epochs([first, first])
    with pytest.raises(GeometryError, match="point of reference 99 is missing in epoch 70 and in epoch 71"):
        analyse_epochs([first, second], reference=["1", "99"])
    kept = np.arange(1, POINTS)
    some = replace(
        second.result, covariance=np.asarray(second.result.covariance)[3:, 3:], covariance_points=kept
    )
    with pytest.raises(GeometryError, match="point of reference 1 cannot be tested in epoch 70 and epoch 71"):
        analyse_epochs([first, replace(second, result=some)], reference=["1"])
    kept = np.arange(3)
    some = replace(
        second.result, covariance=np.asarray(second.result.covariance)[:9, :9], covariance_points=kept
    )
    with pytest.raises(GeometryError, match=f"have {POINTS} points in common, .* here 3$"):
        analyse_epochs([first, replace(second, result=some)])
    with pytest.raises(GeometryError, match=r"group pier: no point .* is called 'P\*'"):
        analyse_epochs([first, second], groups={"pier": ["P*"]})
    with pytest.raises(GeometryError, match="expected one of rigid, similarity, affine"):
        analyse_epochs([first, second], model="bent")
    bare = replace(second, result=replace(second.result, covariance=None, joint=None))
    with pytest.raises(GeometryError, match=r"epoch 71: the covariance of all points together"):
        analyse_epochs([first, bare])
    again = replace(first, name="copy")
    with pytest.raises(GeometryError, match="epoch 70 and copy have the same image points: they are one"):
        analyse_epochs([first, again])
    with pytest.raises(GeometryError, match="share the weighted c of camera lens"):
        analyse_epochs([replace(one, interior=(("lens", "c", 24.0, 0.01),)) for one in (first, second)])


def held(one: Epoch, more: float = 0.0) -> Epoch:
    """Return an epoch as if its interior orientation had been held."""
    camera = one.result.estimate.cameras[0]
    stated = epochs()[0].result.estimate.cameras[0].parameters + more
    camera = replace(camera, parameters=stated, free=np.zeros_like(camera.free))
    estimate = replace(one.result.estimate, cameras=(camera,))
    return replace(one, result=replace(one.result, estimate=estimate))


def test_a_calibration_that_is_held_is_reported(tmp_path: Path) -> None:
    """Its error is in no covariance: what both epochs have of it cancels in part, what one has does not."""
    first, second, _ = epochs()
    (name,) = (camera.name for camera in first.result.estimate.cameras)

    def told(one: Epoch, other: Epoch) -> tuple[Remark, ...]:
        found = analyse_epochs([one, other])
        verdict = verdict_of_epochs(found)
        text = write_page(found, tmp_path / "out").read_text(encoding="utf-8")
        assert all(one.text in text for one in verdict.remarks)
        return tuple(one for one in verdict.remarks if one.kind == "cameras_held")

    assert told(first, second) == ()
    (alike,) = told(held(first), held(second))
    assert alike.names("how") == ("alike",) and alike.names("cameras") == (name,)
    for other in (second, held(second, more=1e-3)):
        (apart,) = told(held(first), other)
        assert apart.names("how") == ("apart",) and apart.names("cameras") == (name,)


def test_epochs_with_other_names_and_of_two_objects_are_reported() -> None:
    first, second, _ = epochs()
    rng = np.random.default_rng(1)
    estimate = second.result.estimate
    order = rng.permutation(POINTS)
    rows = (3 * order[:, None] + np.arange(3)).ravel()
    covariance = np.asarray(second.result.covariance)[np.ix_(rows, rows)]
    for points, kind in (
        (estimate.points[order], "names_differ"),
        (rng.uniform(-1, 1, (POINTS, 3)), "another_object"),
    ):
        result = replace(second.result, estimate=replace(estimate, points=points), covariance=covariance)
        verdict = verdict_of_epochs(analyse_epochs([first, replace(second, result=result)]))
        assert kinds_of(verdict.remarks) == (kind,) and verdict.level == "bad"


def test_an_epoch_is_a_name_and_a_solution() -> None:
    """The solution of an adjustment needs no covariance file, and has its bars and control."""
    network, truth = make_network(seed_of("an epoch"), images=6, points=20)
    seen, found = network.image_points, []
    for k in range(2):
        noise = seed_of(f"noise {k}").normal(0, 0.1, seen.xy.shape)
        measured = replace(network, image_points=replace(seen, xy=seen.xy + noise))
        a = adjust(measured.with_scale_bar(network.points[0], network.points[1], 1.0, 1e-4), truth)
        found.append(Epoch(f"epoch {k}", a.solution))
        assert len(found[k].bars) == 1 and not len(found[k].control)
    displacements = find_displacements(epoch_differences(*found))
    assert displacements.stable.all()
