"""COLMAP's own pipeline as a baseline: what it makes of photographs, and what it cannot use."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from adapters.colmap.adjuster import adjust_with_colmap
from adapters.colmap.mapper import map_photographs
from sfm.errors import BackendError
from sfm.pipeline import run_survey
from sfm.survey.assembly import OtherPrograms
from sfm.survey.inputs.survey import read_survey
from tests.places import ROOT

DATA = ROOT.parent / "shared" / "data"
PHOTOGRAPHS = DATA / "retro-panel" / "images"


def test_photographs_without_texture_give_no_model(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    for name in ("a.png", "b c.png"):
        cv2.imwrite(str(tmp_path / name), np.full((120, 160), 128, dtype=np.uint8))
    with pytest.raises(BackendError, match="COLMAP's mapper found no model"):
        map_photographs(tmp_path, (("a.png", "b c.png"),), threads=1)
    out = capfd.readouterr()
    assert (out.out, out.err) == ("", "")


@pytest.mark.slow
@pytest.mark.skipif(
    not PHOTOGRAPHS.is_dir(), reason="photographs of retro-panel are not beside the repository"
)
def test_retro_panel_is_oriented_by_colmaps_own_pipeline() -> None:
    names = sorted(path.name for path in PHOTOGRAPHS.glob("*.tif"))
    cameras = tuple(tuple(n for n in names if n.startswith(key)) for key in ("043", "671"))
    found = map_photographs(PHOTOGRAPHS, cameras)
    assert found.total == 8
    assert len(found.network.images) == 8
    assert 0.1 < found.rms_px < 0.5  # 0.31 px when written
    assert len(found.estimate.cameras) == 2


@pytest.mark.slow
@pytest.mark.skipif(
    not (DATA / "camcal").is_dir(), reason="photographs of camcal are not beside the repository"
)
def test_camcal_beside_colmaps_own_pipeline() -> None:
    """All photographs get oriented by texture too, but the targets lie several times their sigma away."""
    survey = read_survey(ROOT / "datasets" / "camcal" / "survey.toml")
    result = run_survey(
        survey,
        images_dir=DATA / "camcal" / "images",
        jobs=2,
        others=OtherPrograms(adjust_with_colmap, map_photographs),
    )
    found = result.baseline
    assert result.comparison is not None and result.comparison.agree
    assert found is not None and found.photographs == (21, 21) and found.targets == 100
    assert found.rms_px[0] < 0.14 < 0.4 < found.rms_px[1] < 0.8  # 0.114 and 0.600 px when written
    assert 50e-6 < found.point_rms < 600e-6  # 255 micrometres when written
