"""Mistyped bars, control and units are never believed; right ones are not doubted."""

from __future__ import annotations

import numpy as np
import pytest

from sfm.model.remarks.remark import kinds_of
from sfm.pipeline import run_survey
from sfm.survey.inputs.exterior_table import ObservedExterior
from sfm.survey.inputs.given_values import KnownPoints
from tests.survey.mistyped import CASES, NEVER_FOUND, SIGMA, given_of, mistyped, right, scene, study
from tests.surveys import remarks_on_given, survey_of
from tests.synthetic import seed_of

REFUSED = ("refused", "bad", "fair")
NAMED = {  # bad with the first kinds, fair with the others
    "two of three bars": "scale_contradicted",
    "control mirrored": "given_mirrored",
    "four control, X and Y exchanged": "given_mirrored",
    "five control, X and Y exchanged": "given_mirrored",
    "y upwards, four control": "given_mirrored",
    "y upwards, eight control": "given_mirrored",
    "y upwards, centres": "given_mirrored",
    "centres, X and Y exchanged": "given_mirrored",
    "four of eight control": "given_contradicted",
    "four of eight control, X and Y": "given_contradicted",
    "three of eight control": "given_left_out",
    "four of ten control": "given_left_out",
    "control shifted by a row": "given_renamed",
    "control turned by a row": "given_renamed",
    "checking fixed control turned": "given_renamed",
    "three names of eight turned": "given_renamed",
    "two names exchanged": "given_renamed",
    "two names of a pyramid": "given_contradicted",
    "opposite names of a pyramid": "given_mirrored",
    "one point of a pyramid": "given_left_out",
    "left and right names of a box": "given_mirrored",
    "centres turned by a row": "given_renamed",
    "centres 2 mm off, control": "datum_contradicted",
    "centres 100 m off, control, bars": "datum_contradicted",
    "centres turned, control": "datum_contradicted",
    "centres turned, two control": "datum_contradicted",
    "centres 1 %, control, bars": "scale_left_out",
}
BAD = ("datum_contradicted", "scale_contradicted", "given_mirrored", "given_contradicted")


OF_STUDY = {  # each beside a quick one of the same kind
    "control 2 mm",
    "checking control 50 sigma",
    "five control, X and Y exchanged",
    "y upwards, four control",
    "two names of a box",
    "four of eight control, X and Y",
    "fixed control turned by a row",
    "two names of a pyramid",
    "left and right names of a box",
    "y upwards, eight control",
    "control, X and Y exchanged",
    "centres, X and Y exchanged",
    "three names of eight turned",
    "control shifted by a row",
    "control turned by a row",
    "four of ten control",
    "twenty points too precise, bars",
    "one of two bars 10 %",
    "one of two bars 300 for 400",
    "one of two bars / 10",
    "one of two bars 24 sigma",
    "one of two bars, inches",
    "one of three bars x 1000",
    "one of three bars, wrong end",
    "control, one of two bars 1 %",
    "control 50 sigma",
    "centres turned, control",
}


@pytest.mark.parametrize(
    "case",
    [
        pytest.param(case, marks=[pytest.mark.slow] if case in OF_STUDY else [])
        for case, *_ in CASES
        if case not in NEVER_FOUND
    ],
)
def test_what_is_mistyped_is_found_and_named(case: str) -> None:
    found = mistyped(case, 100)
    assert not found.is_wrong_and_good
    assert found.level in REFUSED or case == "control 6 sigma"
    assert found.kinds or found.level in ("refused", "good")
    if case in NAMED:
        assert NAMED[case] in found.kinds and (found.level == "bad") is (NAMED[case] in BAD)


def test_right_bars_and_control_are_good() -> None:
    assert [one.level for one in map(right, range(1000, 1011))] == ["good"] * 11


def test_neither_control_nor_centres_are_used_where_they_contradict() -> None:
    network, truth = scene("both")
    given = given_of(seed_of("both"), truth, 0, 6)
    centres = truth.position + SIGMA * seed_of("centres").standard_normal(truth.position.shape)
    for shift, kinds in ((0.0, ()), (0.02, ("datum_contradicted",))):
        seen = centres + np.array([shift, 0, 0])
        parts = {
            "control": KnownPoints.from_arrays([str(j + 1) for j in given.names], given.xyz, SIGMA),
            "exterior": ObservedExterior.from_arrays(network.images, seen, SIGMA),
            "datum": {"kind": "control"},
        }
        result = run_survey(survey_of(network, truth, **parts))
        said = [one for one in remarks_on_given(result) if one.severity != "note"]
        assert kinds_of(said) == kinds and result.has_scale == (not shift)
        assert len(result.adjustment.network.control) == (0 if shift else 6)
        assert len(result.adjustment.network.exterior) == (0 if shift else 8)
        assert ("scale_undefined" in kinds_of(result.remarks)) == (shift > 0)
    assert said[0].names("given") == ("control", "centres") and said[0].number("dof") == 7
    assert said[0].number("distance") == pytest.approx(shift, rel=0.2)


@pytest.mark.slow
def test_mistyped_surveys_of_many_networks() -> None:
    found = study([one[0] for one in CASES], 6, 200)
    detectable = [one for one in found if one.case not in NEVER_FOUND]
    assert not any(one.is_wrong_and_good for one in detectable)
    planted = [one for one in found[:-200] if one.case not in (*NEVER_FOUND, "control 6 sigma")]
    assert sum(one.level == "good" for one in planted) <= 0.02 * len(planted)  # what is too small to be found
    assert sum(one.level != "good" for one in found[-200:]) <= 1
