"""What a survey of targets, texture and given points states and reaches, against truth and each alone."""

from __future__ import annotations

import numpy as np
import pytest

from tests.survey.several_sources import study

NUMBERS = 3  # of the twenty of `python -m tests.survey.several_sources`


@pytest.mark.slow
def test_each_source_is_as_precise_as_stated_and_none_is_worse_than_alone() -> None:
    found = study(0, NUMBERS)
    assert all(one.oriented == 30 and one.few_targets >= 10 and one.level != "bad" for one in found)

    def rms(values: list[float]) -> float:
        return float(np.sqrt(np.mean(np.square(values))))

    for source in ("targets", "given", "texture"):
        assert 0.8 < rms([one.accuracy[source].relative for one in found]) < 1.25
    # targets gain from texture; texture alone is as precise, as its errors are those of the windows
    for of, most in (("of_targets", 1.0), ("of_texture", 1.2)):
        together, alone = (np.array([getattr(one, of)[k] for one in found]) for k in (0, 1))
        assert np.median(together / alone) < most
    assert all(abs(error) < 3 * sigma and sigma < 1.1e-5 for error, sigma in (one.scale for one in found))
