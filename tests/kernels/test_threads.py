"""A second thread for the adjustment, where there is one, within a survey too."""

from __future__ import annotations

from threading import get_ident

from threadpoolctl import threadpool_info

from sfm.kernels.threads import at_once, own_threads


def _blas() -> list[int]:
    return [one["num_threads"] for one in threadpool_info() if one["user_api"] == "blas"]


def test_a_second_thread_is_at_hand_where_there_are_two() -> None:
    before = _blas()
    with own_threads(2):
        outer = at_once(get_ident, get_ident)
        with own_threads():  # of an adjustment, whose pools have one thread here
            assert set(_blas()) == {1}
            inner = at_once(get_ident, get_ident)
        after = at_once(get_ident, get_ident)
    assert outer == inner == after and outer[0] == get_ident() != outer[1]
    assert _blas() == before


def test_one_thread_alone() -> None:
    with own_threads(1), own_threads():
        assert at_once(get_ident, get_ident) == (get_ident(), get_ident())
    assert at_once(get_ident, get_ident) == (get_ident(), get_ident())
