"""COLMAP's own pipeline as a baseline: what it makes of photographs, and what it cannot use."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from adapters.colmap_mapper import map_photographs
from sfm.errors import BackendError

PHOTOGRAPHS = Path(__file__).resolve().parents[2] / "shared" / "data" / "retro-panel" / "images"


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
