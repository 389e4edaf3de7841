"""Clocks of a rig that fit at two offsets: the photographs show which one is right."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from sfm.remarks.remark import kinds_of, remark
from sfm.survey.clock_offsets import agree_on_clocks, rotation_spread
from sfm.survey.inputs.start import measurements_from_observations
from sfm.survey.inputs.survey import read_survey
from sfm.survey.orientation import orient_with_models
from sfm.survey.rigs import with_moments
from tests.rigs import make_rig
from tests.survey.test_rigs import written
from tests.synthetic import seed_of


@pytest.mark.parametrize("wrong", [True, False])
def test_the_offset_at_which_cameras_keep_their_mounts_is_taken(wrong: bool, tmp_path: Path) -> None:
    """One camera misses the first photograph, and its clock is one interval off."""
    network, truth = make_rig(seed_of("clocks"), moments=8)
    survey = read_survey(written(tmp_path, network, truth))
    measured = measurements_from_observations(survey)
    camera, moment = measured.network.camera, measured.network.moment
    assert moment is not None
    names = np.array(measured.network.images)
    right = dict(zip(names.tolist(), [f"{k:02d}" for k in moment], strict=True))
    late = {name: f"{k + (c == 1):02d}" for name, k, c in zip(names.tolist(), moment, camera, strict=True)}
    now, other = (late, right) if wrong else (right, late)
    rig = survey.rigs[0].model_copy(update={"moment": "moments.csv"})
    survey = replace(survey, rigs=(rig,), moments=now, other_moments=other)
    unsure = remark("clocks_unsure", camera="camera 2", reference="camera 1", ahead=(10.0, "s"))
    measured = replace(
        measured, network=with_moments(survey, replace(measured.network, moment=None)), remarks=(unsure,)
    )
    found, agreed, start = agree_on_clocks(survey, measured, orient_with_models(survey, measured)[2])
    assert found.moments == right
    assert kinds_of(agreed.remarks) == (("clock_differs",) if wrong else ("clocks_unsure",))
    assert agreed.network.moment is not None and start.estimate.mounts is not None
    spread, count = rotation_spread(agreed.network.camera, agreed.network.moment, start.estimate)
    assert count == 8 and spread < 1e-5
    base = start.estimate.mounts.position[1] / np.linalg.norm(start.estimate.mounts.position[1])
    assert truth.mounts is not None
    true = truth.mounts.position[1] / np.linalg.norm(truth.mounts.position[1])
    assert base @ true > 0.999
