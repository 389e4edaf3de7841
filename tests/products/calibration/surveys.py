"""Survey files of simulated boards, for tests of the calibration of a survey."""

from __future__ import annotations

from pathlib import Path

from tests.products.calibration.boards import SimulatedBoard, board_points
from tests.surveys import observed_text
from tests.synthetic import seed_of

CAMERA = """\
name = "cam"
size_px = [1200, 900]
pixel_mm = [0.005, 0.005]
c_mm = 6.0
"""
GIVEN = """\
[control]
file = "control.csv"
[datum]
kind = "control"
"""
ALL = 'free = ["c", "x0", "y0", "K1", "K2", "P1", "P2"]'


def write_board_survey(
    folder: Path,
    board: SimulatedBoard,
    *,
    name: str = "board",
    camera: str = CAMERA,
    free: str = ALL,
    noise: bool = True,
) -> Path:
    """Write the survey of a simulated board, with errors that depend on the name; return its file."""
    folder.mkdir(parents=True)
    network = board.noisy(seed_of(name)) if noise else board.network
    seen = network.image_points
    rows = ["image,point,x_px,y_px,sx_px,sy_px"]
    rows += [
        f"{network.images[i]},{network.points[j]},{x!r},{y!r},0.1,0.1"
        for i, j, (x, y) in zip(seen.image, seen.point, seen.xy.tolist(), strict=True)
    ]
    (folder / "image_points.csv").write_text("\n".join(rows) + "\n", encoding="utf-8")
    given = ["id,X,Y,Z"]
    given += [f"p{j},{x!r},{y!r},{z!r}" for j, (x, y, z) in enumerate(board_points().tolist())]
    (folder / "control.csv").write_text("\n".join(given) + "\n", encoding="utf-8")
    path = folder / "survey.toml"
    path.write_text(observed_text(name, "mm", camera + free, further=GIVEN), encoding="utf-8")
    return path
