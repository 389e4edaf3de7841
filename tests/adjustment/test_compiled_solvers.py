"""Networks that are made up to compile kernels reach every solver, and larger ones need no other forms."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from sfm.adjustment import solve
from sfm.adjustment.datum import Datum
from sfm.adjustment.engine.cofactors import Cofactors, _complement, cofactors
from sfm.adjustment.engine.solvers import dense, fronts, multifrontal, multifrontal_factor
from sfm.adjustment.engine.solvers import fronts as pairs
from sfm.adjustment.solve import adjust
from sfm.cli.warm_up import MANY_IMAGES, _scattered, _strip, made_up_network
from sfm.model.conventions import AnyArray

FRONTS = (
    fronts.distances,
    fronts._place,
    multifrontal._sum_front,
    multifrontal.extend,
    multifrontal_factor._pick,
    multifrontal_factor._by_border,
    multifrontal_factor._sum_pairs,
)
PAIRED = (
    pairs._cut,
    pairs._subtract_tile,
    pairs.subtract_border,
    pairs._border_times,
    pairs._add_tile,
    dense._core,
)


@pytest.mark.parametrize(("sees", "kernels"), [(_strip(), FRONTS), (_scattered(), PAIRED)])
def test_every_solver_is_compiled(sees: AnyArray, kernels: tuple[Any, ...]) -> None:
    """A strip has fronts, scattered points a full matrix summed ray by ray; each kernel has one form."""
    network, truth = made_up_network(sees)
    assert len(network.images) == MANY_IMAGES
    assert adjust(network, truth, datum=Datum("free"), reject="none").converged
    for kernel in kernels:
        assert len(kernel.signatures) == 1, kernel


def test_covariances_stored_by_columns_need_no_other_form(monkeypatch: pytest.MonkeyPatch) -> None:
    """Those of more than 3600 points are: numpy takes the place of a large intermediate result for a sum."""
    network, truth = made_up_network()

    def by_columns(*given: Any, **settings: Any) -> Cofactors:
        Q = cofactors(*given, **settings)
        return replace(Q, points=np.swapaxes(np.swapaxes(Q.points, 1, 2).copy(), 1, 2))

    adjust(network, truth, datum=Datum("free"), reject="none")
    before = set(_complement.signatures)  # type: ignore[attr-defined]
    monkeypatch.setattr(solve, "cofactors", by_columns)
    adjust(network, truth, datum=Datum("free"), reject="none")
    assert set(_complement.signatures) == before  # type: ignore[attr-defined]
