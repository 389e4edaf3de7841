"""A command whose page has a bad verdict ends with exit code 1, whatever the command."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from adapters.formats.result_tables import write_tables
from sfm.adjustment.solve import adjust
from tests.commands import kolinear
from tests.rigs import make_rig
from tests.synthetic import make_network, seed_of


def _result(folder: Path, seed: int, *, mirrored: bool = False) -> Path:
    """Write the tables of an adjusted network of one object, or of its mirror image."""
    network, truth = make_network(seed_of("one object"), images=6, points=30)
    seen = network.image_points
    noise = seed_of(f"epoch {seed}").normal(0, 0.1, seen.xy.shape)
    network = replace(network, image_points=replace(seen, xy=seen.xy + noise))
    solved = adjust(network, truth, reject="none").solution.with_joint_covariance
    if mirrored:
        flipped = solved.estimate.points * (1.0, 1.0, -1.0)
        solved = replace(solved, estimate=replace(solved.estimate, points=flipped))
    write_tables(folder, replace(solved, name=folder.name, unit="m"))
    return folder


@pytest.mark.parametrize("command", ["epochs", "compare"])
def test_results_that_cannot_be_compared_end_with_exit_code_1(command: str, tmp_path: Path) -> None:
    first, second = (_result(tmp_path / str(seed), seed) for seed in (1, 2))
    assert kolinear(command, first, second, "--out", tmp_path / "good") == 0
    mirrored = _result(tmp_path / "mirrored", 2, mirrored=True)
    assert kolinear(command, first, mirrored, "--out", tmp_path / "bad") == 1
    assert list((tmp_path / "bad").glob("*.html"))


def test_a_plan_that_determines_nothing_ends_with_exit_code_1(tmp_path: Path) -> None:
    """Two photographs and a free camera; the page is written all the same."""
    camera = ("--camera", "full-frame-24", "--c-mm", "24", "--sigma-px", "0.1")
    for stations, code in (("two-rings:16", 0), ("front-back", 1)):
        out = tmp_path / stations.partition(":")[0]
        asked = ("plate:500,400", *camera, "--stations", stations, "--out", out)
        assert kolinear("plan", "network", *asked) == code
        assert (out / "plan.html").is_file() or list(out.glob("*.html"))


def test_rig_files_state_the_unit_and_do_not_deny_it(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    network, truth = make_rig(seed_of("unit of a rig"))
    solved = adjust(network, truth, reject="none").solution
    write_tables(tmp_path / "result", replace(solved, name="rig", unit="mm"))
    capsys.readouterr()
    assert kolinear("convert", tmp_path / "result", tmp_path / "rig", "--to", "rig") == 0
    assert "unit of lengths" not in capsys.readouterr().out
    stated = [path.read_text("utf-8") for path in (tmp_path / "rig").glob("opencv-*.yml")]
    assert stated and all("mm" in text for text in stated)
