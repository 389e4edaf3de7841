"""The memory that a solver says it needs is what it takes, and what does not fit is refused."""

from __future__ import annotations

import subprocess
import sys
import tracemalloc
from pathlib import Path

import numpy as np
import pytest

from sfm.adjustment.datum import Datum, motions_of
from sfm.adjustment.engine.normals import new_space, normal_equations
from sfm.adjustment.engine.observed import observed_of
from sfm.adjustment.engine.solvers import choice
from sfm.adjustment.engine.solvers import protocol as memory
from sfm.adjustment.engine.solvers.choice import choose_solver
from sfm.adjustment.engine.solvers.dense import DenseSolver
from sfm.adjustment.engine.solvers.fronts import pairs_of
from sfm.adjustment.engine.solvers.multifrontal import MultifrontalSolver
from sfm.adjustment.engine.unknowns import Unknowns, unknowns_of
from sfm.model.errors import GeometryError
from sfm.model.estimate import Estimate
from sfm.model.network import ImagePoints, Network
from sfm.runtime import memory as system
from sfm.runtime.threads import own_threads
from tests.adjustment.test_null_space import halves, in_fronts, together
from tests.synthetic import make_network, seed_of
from tests.synthetic_blocks import FREE, aerial, run

NEAR = 0.2  # of what is measured; one thread has rows of half of the points at a time, two have all


def pair_by_pair(layout: Unknowns) -> DenseSolver:
    return DenseSolver(layout, pairs_of(layout.observations))


def measured(network: Network, estimate: Estimate, way: object) -> tuple[float, float]:
    """Return the memory at the peak of factor and inverse, results apart, bytes, and what the solver says."""
    layout, state = unknowns_of(network, estimate, use_control=False)
    observed = observed_of(network, layout, state, use_control=False)
    solver = way(layout)  # type: ignore[operator]
    equations = normal_equations(
        layout, observed, state, layout.active.astype(float), space=new_space(layout)
    )
    motions = motions_of(layout, observed, state, Datum("free").resolve(network))
    with own_threads():
        for counted in (False, True):  # compiled at first
            if counted:
                tracemalloc.start()
            inverse = solver.factor(equations, motions).inverse(equations, cross=False)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    results = (inverse.exterior, inverse.core, inverse.YQ_border)
    return peak - sum(part.nbytes for part in results), solver.bytes


@pytest.mark.parametrize("way", [choose_solver, DenseSolver, pair_by_pair])
@pytest.mark.parametrize(
    ("strips", "per_strip", "points"),
    [(10, 16, 3000), pytest.param(20, 20, 20000, marks=pytest.mark.slow)],
)
def test_a_solver_takes_the_memory_that_it_says(
    way: object, strips: int, per_strip: int, points: int
) -> None:
    network, truth = aerial(f"memory {strips}", strips, per_strip, points)
    peak, said = measured(network, truth, way)
    assert said == pytest.approx(peak, rel=NEAR)


@pytest.mark.parametrize("way", [in_fronts, DenseSolver, pair_by_pair])
def test_null_vectors_are_sought_within_that_memory(way: object) -> None:
    network, truth = together(halves("memory", FREE))
    peak, said = measured(network, truth, way)
    assert peak < said * (1 + NEAR)


def test_a_full_matrix_that_does_not_fit_gives_way_to_fronts(monkeypatch: pytest.MonkeyPatch) -> None:
    network, truth = aerial("gives way", 6, 14, 1700)
    layout, _ = unknowns_of(network, truth, use_control=False)
    monkeypatch.setattr(choice, "FACTOR_RATE", 1e30)
    full = choose_solver(layout)
    assert isinstance(full, DenseSolver)
    monkeypatch.setattr(memory, "available_bytes", lambda: full.bytes / 2)
    assert isinstance(choose_solver(layout), MultifrontalSolver)


def test_a_container_may_have_less_memory_than_the_computer(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    limit = tmp_path / "memory.max"
    (tmp_path / "memory.current").write_text("1000000\n", encoding="ascii")
    monkeypatch.setattr(system, "GROUPS", tmp_path)
    whole = memory.available_bytes.__wrapped__()
    for said, expected in (("max\n", whole), ("2000000\n", memory.SHARE * 2e6), (f"{2**63}\n", whole)):
        limit.write_text(said, encoding="ascii")
        assert memory.available_bytes.__wrapped__() == expected


@pytest.mark.skipif(sys.platform == "win32", reason="no limits of a process")
def test_a_process_may_have_less_memory_than_the_computer() -> None:
    told = "from sfm.adjustment.engine.solvers.protocol import available_bytes as a; print(a())"
    limited = f"ulimit -v 3000000; exec {sys.executable} -c '{told}'"
    done = subprocess.run(["sh", "-c", limited], capture_output=True, text=True, check=True)
    assert float(done.stdout) <= memory.SHARE * 3000000 * 1024


@pytest.mark.parametrize(("strips", "unknowns"), [(3, "all connected"), (6, "of 84 photographs")])
def test_what_does_not_fit_is_refused(strips: int, unknowns: str, monkeypatch: pytest.MonkeyPatch) -> None:
    network, truth = aerial("refused for memory", strips, 14, 280 * strips)
    monkeypatch.setattr(memory, "available_bytes", lambda: 1e4)
    with pytest.raises(GeometryError, match=f"{unknowns} need .* GB"):
        run(network, truth)


def test_what_is_too_large_is_refused_before_its_orientation(monkeypatch: pytest.MonkeyPatch) -> None:
    """20,000 photographs that all see 10 points; not those of strips, of which fronts are small."""
    m, n = 20_000, 10
    image, point = np.repeat(np.arange(m), n), np.tile(np.arange(n), m)
    seen = ImagePoints(image, point, np.zeros((m * n, 2)), np.tile(np.eye(2), (m * n, 1, 1)))
    names = tuple(str(k) for k in range(m))
    network = Network(names, np.zeros(m, dtype=np.int64), names[:n], seen)
    monkeypatch.setattr(memory, "available_bytes", lambda: 20e9)
    with pytest.raises(GeometryError, match="120000 unknowns that are all connected need 346 GB"):
        choice.refuse_too_large(network)
    strips, _ = aerial("too large", 6, 14, 1700)
    monkeypatch.setattr(memory, "available_bytes", lambda: 1e6)
    choice.refuse_too_large(strips)
    joined, _ = make_network(seed_of("too large"), images=40, points=20)
    with pytest.raises(GeometryError, match="240 unknowns"):
        choice.refuse_too_large(joined)
    monkeypatch.setattr(memory, "available_bytes", lambda: 3 * 8 * 240.0**2)
    choice.refuse_too_large(joined)
