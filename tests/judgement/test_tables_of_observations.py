"""Tables of observations against one another: single rows, imprecise ones, and whole kinds."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from sfm.judgement.given import tables
from sfm.judgement.given.tables import Contradiction, Table, _Judge, as_judged, judge_tables
from sfm.judgement.given.values import GivenModel
from sfm.model.conventions import BoolArray, FloatArray, IntArray
from tests.synthetic import seed_of

LEVEL = 1e-3


@dataclass(frozen=True)
class Rows:
    """Observations of one number each, which all have a constant in common."""

    name: str
    v: FloatArray
    mended: str = ""  # a mistake
    by: float = 0.0  # less the values it makes the right ones; 0: they are then all right
    sigma: float = 1.0

    def __len__(self) -> int:
        return len(self.v)

    def select_parts(self, on: BoolArray) -> Rows:
        return replace(self, v=self.v[on])

    def select(self, _: object) -> Rows:
        return self

    def with_sigma(self, sigma: float) -> Rows:
        return replace(self, sigma=sigma)

    def mistakes(self) -> dict[str, Rows]:
        right = self.by - self.v if self.by else np.zeros(len(self.v))
        return {self.mended: replace(self, v=right)} if self.mended else {}


class Reference:
    """Differences of such observations, which have no scale."""

    marginal = SimpleNamespace(adjustment=SimpleNamespace(redundancy=300))

    def differences(self, kinds: Sequence[Rows], _: object) -> tuple[GivenModel, IntArray]:
        v = np.concatenate([np.zeros(0), *(one.v for one in kinds)])
        m, of = len(v), np.repeat(np.arange(len(kinds)), [len(one) for one in kinds])
        sigma = np.concatenate([np.zeros(0), *(np.full(len(one), one.sigma) for one in kinds)])
        A = np.zeros((m, 7))
        A[:, 0] = 1.0
        return GivenModel(v, 1e-6 * np.eye(m), np.diag(sigma**2), A, np.arange(m), 300), of


class WithoutRows:
    """A network that has none of the rows."""

    def with_given(self, further: Any) -> WithoutRows:
        return self


@pytest.fixture
def right(monkeypatch: pytest.MonkeyPatch) -> list[Rows]:
    """What is judged before the tables; nothing at first."""
    found: list[Rows] = []
    monkeypatch.setattr(tables, "confirmed", lambda _: found)
    return found


def judge() -> _Judge:
    network: Any = WithoutRows()
    reference: Any = Reference()
    return _Judge(network, reference, lambda _: None, LEVEL)  # type: ignore[arg-type, return-value]


def table(number: int, name: str, *v: float, mended: str = "", by: float = 0.0) -> Table:
    rows: Any = Rows(name, np.array(v), mended, by)
    return Table(rows, number, np.arange(len(v)))


@pytest.fixture(autouse=True)
def of_rows(monkeypatch: pytest.MonkeyPatch) -> None:
    """Rows in place of a kind of observations."""
    monkeypatch.setattr(tables, "TableKind", Rows)


def test_rows_that_fit_contradict_nothing(right: list[Rows]) -> None:
    rng = seed_of("rows that fit")
    some = [table(0, "heights", *rng.normal(size=6)), table(1, "distances", *rng.normal(size=5))]
    assert judge().fit([one.kind for one in some])
    assert judge_tables(some, *_given()) == ()
    right.append(Rows("bars", np.array([30.0, 30.5, 29.5])))  # with which they are all 30 off
    assert not judge().fit([one.kind for one in some])


def _given() -> tuple[Any, Any, Any, float]:
    return WithoutRows(), Reference(), lambda _: None, LEVEL


def test_single_rows_are_left_out(right: list[Rows]) -> None:
    some = [table(0, "heights", 0.5, -0.5, 40.0, 0.2, 0.0), table(1, "distances", 0.3, -60.0, 0.1, -0.2)]
    found = judge().contradicting(some)
    assert found == [Contradiction("heights", ((0, 2),)), Contradiction("distances", ((1, 1),))]
    kept = as_judged(some, found)
    assert [one.parts.tolist() for one in kept] == [[0, 1, 3, 4], [0, 2, 3]]
    assert [len(one.kind) for one in kept] == [4, 3]
    assert judge_tables(some, *_given()) == tuple(found)


@pytest.mark.parametrize(("wrong", "whole"), [(2, False), (3, True)])
def test_a_kind_most_of_whose_rows_are_wrong_is_left_out_whole(
    wrong: int, whole: bool, right: list[Rows]
) -> None:
    """Half of it are single rows."""
    off = [40.0, -70.0, 90.0][:wrong]
    some = [table(0, "heights", *off, *[0.1] * (4 - wrong)), table(1, "distances", *[0.2, -0.2] * 5)]
    (one,) = judge().contradicting(some)
    assert (one.kind, one.whole) == ("heights", whole)
    assert one.parts == (tuple((0, k) for k in range(4)) if whole else tuple((0, k) for k in range(wrong)))
    if whole:
        assert as_judged(some, [one])[0].kind.name == "distances"


@pytest.mark.parametrize(("rows", "confirmed"), [(5, True), (3, False)])
def test_the_rest_must_have_more_freedom_than_the_kind_takes(
    rows: int, confirmed: bool, right: list[Rows]
) -> None:
    """Three heights that agree with one another, but not with other rows: these less one are confirmed."""
    some = [table(0, "heights", 30.0, 30.1, 29.9), table(1, "distances", *[0.2, -0.2, 0.1, 0.0, -0.1][:rows])]
    assert judge()._rest(some, "heights") == (rows - 1 if confirmed else None)
    assert judge()._rest(some[:1], "heights") is None


def test_image_points_confirm_the_rest_where_a_kind_contradicts_them_alone(right: list[Rows]) -> None:
    some = [table(0, "heights", 30.0, -20.0, 29.9), table(1, "distances", 0.2, -0.2, 0.1)]
    assert judge()._rest(some, "heights") == 2 + 300


def test_values_that_are_right_count_with_the_rest(right: list[Rows]) -> None:
    right.append(Rows("bars", np.array([0.1, -0.1, 0.0])))
    some = [table(0, "heights", 30.0, 30.1, 29.9)]
    (one,) = judge().contradicting(some)
    assert one.kind == "heights" and one.whole
    assert one.rest is None  # 2 of the rest, 3 of the heights
    right.append(Rows("control", np.zeros(4)))
    (one,) = judge().contradicting(some)  # nothing contradicts without them
    assert one.kind == "heights" and one.whole and one.rest == 6


def test_the_kind_that_scatters_is_imprecise(right: list[Rows]) -> None:
    rng = seed_of("imprecise kind")
    rough, fine = 6 * rng.normal(size=20), rng.normal(size=20)
    some = [table(0, "heights", *rough), table(1, "distances", *fine)]
    assert judge()._imprecise(some, 6.0) == [Contradiction("heights", factor=6.0)]
    assert judge()._imprecise(some[::-1], 6.0) == [Contradiction("heights", factor=6.0)]
    both = [table(0, "heights", *rough), table(1, "distances", *(6 * fine))]
    found = judge().contradicting(both)
    assert [one.kind for one in found] == ["heights", "distances"] and not any(one.parts for one in found)
    assert found[0].factor == found[1].factor == pytest.approx(6.0, rel=0.3)
    kept = as_judged(both, found)
    assert [one.kind.sigma for one in kept] == [found[0].factor] * 2  # type: ignore[attr-defined]


def test_a_mistake_explains_where_its_correction_makes_all_agree(right: list[Rows]) -> None:
    right.append(Rows("bars", np.zeros(6)))
    some = [table(0, "heights", *[50.0, -80.0, 60.0], mended="feet"), table(1, "distances", 0.1, 0.2)]
    (one,) = judge().explained(some)
    assert one == Contradiction("heights", ((0, 0), (0, 1), (0, 2)), True, ("feet",))
    (said,) = judge_tables(some, *_given())
    assert said == one
    wrong = [*some[:1], table(1, "distances", 90.0, -40.0)]
    assert list(judge().explained(wrong)) == []  # it does not explain the other kind
    assert judge()._mistakes([some[1].kind], []) == ()  # which has nothing to correct


def test_tables_of_one_kind_may_have_a_mistake_each(right: list[Rows]) -> None:
    """Both together are no mistake of both, where one of them is right."""
    right.append(Rows("bars", np.zeros(6)))
    some = [
        table(0, "heights", 50.0, -80.0, 60.0, mended="feet"),
        table(1, "heights", 0.1, 0.2, -0.1, mended="feet", by=500.0),
    ]
    (one,) = judge().explained(some)
    assert one.parts == ((0, 0), (0, 1), (0, 2)) and one.mistakes == ("feet",)
    alone = [some[0], table(1, "heights", 50.0, -30.0, mended="feet")]
    (one,) = judge().explained(alone)
    assert one.whole and len(one.parts) == 5


def test_rows_that_are_left_out_are_named_with_their_mistake(right: list[Rows]) -> None:
    right.append(Rows("bars", np.zeros(6)))
    some = [table(0, "heights", 0.1, 70.0, -0.2, 0.3, 0.0, mended="feet", by=70.0)]
    (one,) = judge_tables(some, *_given())
    assert one.parts == ((0, 1),) and not one.whole
    assert one.mistakes == ("feet",)


def test_what_most_contradicts_is_blamed_where_nothing_else_fits(right: list[Rows]) -> None:
    """Three kinds of which two are wrong: without none do the others fit."""
    some = [
        table(0, "heights", 90.0, -40.0, 70.0, -60.0),
        table(1, "distances", *[0.1, -0.1] * 3),
        table(2, "angles", 9.0, -8.0, 7.0, 12.0),
    ]
    (one,) = judge().contradicting(some)
    assert one.kind == "heights" and one.whole and one.rest is None
