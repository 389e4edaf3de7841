"""Rendered photographs that do not fit one another: what each survey of them ends as.

    python -m tests.survey.confusions

prints for each confusion the verdict, sigma0 and what is said to be the cause. Nine photographs show 22 codes
on two plates; c, x0 and y0 are free. The seeds of the scenes are none that anything was tuned to.
"""

from __future__ import annotations

import sys
import tempfile
from dataclasses import dataclass, field
from pathlib import Path

import cv2
import numpy as np

from sfm.camera import Camera, camera_from_values
from sfm.conventions import AnyArray, FloatArray
from sfm.errors import KolinearError
from sfm.pipeline import run_survey
from sfm.remarks.remark import of_kind
from sfm.rendering.render import render_photograph
from sfm.rendering.scene import Optics, Scene
from sfm.report.findings.survey_remarks import findings_of
from sfm.survey.inputs.survey import read_survey
from tests.survey.judging import CAUSES
from tests.survey.two_plates import FIRST_CODE, PLACES, two_plates
from tests.surveys import C_MM, PIXEL_MM, SIZE_PX, SURVEY, stations
from tests.synthetic import seed_of

PHOTOGRAPHS = 9
MOVED_MM = 6.0


@dataclass(frozen=True)
class Confusion:
    """What is wrong with some of the photographs."""

    name: str
    zoom: dict[int, float] = field(default_factory=dict)  # factor of c of a photograph
    shifted: tuple[int, ...] = ()  # photographs of a second body: c 0.3 % and principal point 10 px away
    moved: tuple[int, ...] = ()  # photographs in which half of the codes lie elsewhere
    K1: float = 0.0  # of all photographs, mm^-2, which the survey holds at 0


CONFUSIONS = (
    Confusion("nothing"),
    *(Confusion(f"one zoomed by {p} %", zoom={4: 1 + p / 100}) for p in (2, 3, 5, 10)),
    Confusion("two zooms, 5 %", zoom=dict.fromkeys(range(4), 1.05)),
    Confusion("two cameras", shifted=(1, 3, 6)),
    Confusion("half of it moved", moved=(5, 6, 7, 8)),
    Confusion("distortion held", K1=1.5e-3),
)


def scene_of(moved_mm: float) -> Scene:
    """Return two plates with codes; those of odd place lie elsewhere."""
    aside = moved_mm * np.array([1.0, 0.5])
    return two_plates(
        {FIRST_CODE + k: k for k in range(len(PLACES))},
        {FIRST_CODE + k: aside for k in range(1, len(PLACES), 2)},
    )


def camera_of(confusion: Confusion, k: int) -> Camera:
    """Return the camera that a photograph was taken with."""
    factor = confusion.zoom.get(k, 1.003 if k in confusion.shifted else 1.0)
    camera = camera_from_values("small", "brown", SIZE_PX, (PIXEL_MM, PIXEL_MM), c_mm=C_MM * factor)
    p: FloatArray = camera.parameters.copy()
    p[camera.names.index("K1")] = confusion.K1
    if k in confusion.shifted:
        p[camera.names.index("y0")] = 10 * PIXEL_MM
    return camera.with_parameters(p)


def photographs(confusion: Confusion) -> list[AnyArray]:
    """Render the photographs."""
    position, rotation = stations(PHOTOGRAPHS)
    rng = seed_of(f"confused {confusion.name}")
    position += rng.uniform(-15, 15, position.shape)
    whole, moved = scene_of(0.0), scene_of(MOVED_MM)
    return [
        render_photograph(
            moved if k in confusion.moved else whole,
            camera_of(confusion, k),
            position[k],
            rotation[k],
            optics=Optics(blur_px=0.7, exposure=0.9, noise=2 / 255),
            rng=rng,
        )[0]
        for k in range(PHOTOGRAPHS)
    ]


def outcome(confusion: Confusion, folder: Path) -> str:
    """Run the survey of a confusion and say in a line what came of it."""
    folder.mkdir()
    for k, picture in enumerate(photographs(confusion), 1):
        cv2.imwrite(str(folder / f"photo {k}.png"), picture, [cv2.IMWRITE_PNG_COMPRESSION, 1])
    text = SURVEY.format(name=folder.name, backend="none").replace('["c"]', '["c", "x0", "y0"]')
    (folder / "survey.toml").write_text(text, encoding="utf-8")
    try:
        result = run_survey(read_survey(folder / "survey.toml"))
    except KolinearError as error:
        return f"{confusion.name:18} refused: {error}"
    a, verdict = result.adjustment, findings_of(result).verdict
    told = [f"{one.image}: {one.reason.text}" for one in result.failed]
    told += [one.text for one in of_kind(result.remarks, *CAUSES)]
    counts = (
        f"{len(a.network.images)} of {PHOTOGRAPHS} oriented, {len(a.network.points):3} points, "
        f"{int(a.rejected.sum()):3} image points rejected, sigma0 {a.sigma0_px:.3f} px"
    )
    return f"{confusion.name:18} {verdict.level:5} {counts}; {' | '.join(told) or 'nothing is told'}"


def main() -> int:
    """Print the table."""
    with tempfile.TemporaryDirectory() as folder:
        for k, confusion in enumerate(CONFUSIONS):
            print(outcome(confusion, Path(folder) / str(k)), flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
