"""The page of conventions: its numbers are the program's, what it says of COLMAP is what pycolmap writes."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from tests.pages import examples_of, run_examples, show, text_of

PAGE = "conventions.md"


@pytest.fixture(scope="module")
def names(tmp_path_factory: pytest.TempPathFactory) -> dict[str, object]:
    """What the examples of the page have computed."""
    found: dict[str, object] = {"folder": tmp_path_factory.mktemp("page"), "show": show}
    results = run_examples(PAGE, found)
    assert results.attempted > 30
    assert not results.failed, "see what is printed: the page differs from the program"
    return found


def test_every_example_of_the_page_is_one_that_runs(names: dict[str, object]) -> None:
    """No block of the page is left out, as by another name of its language."""
    assert examples_of(PAGE).count(">>> ") == text_of(PAGE).count("\n>>> ")


def test_colmap_is_given_what_the_page_says(names: dict[str, object], tmp_path: Path) -> None:
    pytest.importorskip("pycolmap")
    from adapters.colmap.camera_models import write_model
    from sfm.model.estimate import Estimate
    from sfm.model.network import Network

    camera, R, X0 = (names[name] for name in ("opencv", "R", "X0"))
    network = names["network"]
    assert isinstance(network, Network)
    write_model(tmp_path, network, Estimate((camera,), X0[None], R[None], names["X"]), text=True)
    lines = [
        line.split()
        for line in (tmp_path / "images.txt").read_text(encoding="utf-8").splitlines()
        if not line.startswith("#")
    ]
    w, x, y, z = (float(one) for one in lines[0][1:5])
    of_quaternion = np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )
    np.testing.assert_allclose(of_quaternion, names["R_colmap"], atol=1e-12)
    np.testing.assert_allclose([float(one) for one in lines[0][5:8]], names["t"], atol=1e-12)
    measured = network.image_points.xy[0]
    np.testing.assert_allclose([float(one) for one in lines[1][:2]], measured + 0.5, atol=1e-9)
    written = (tmp_path / "cameras.txt").read_text(encoding="utf-8").splitlines()[-1].split()
    np.testing.assert_allclose([float(one) for one in written[6:8]], camera.parameters[2:4] + 0.5, atol=1e-9)
