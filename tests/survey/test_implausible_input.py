"""Input that cannot be right is refused in one line with the likely reason, or left out by name."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from sfm.conventions import image_from_pixel
from sfm.errors import SurveyFileError
from sfm.remarks.remark import kinds_of
from sfm.survey.inputs.start import MARGIN_PX, MAX_OUTSIDE, measurements_from_observations, outside_photograph
from sfm.survey.inputs.survey import read_survey
from tests.surveys import write_observed_survey
from tests.synthetic import PIXEL_MM, SIZE_PX

Rows = list[list[str]]


def rewritten(folder: Path, change: Callable[[Rows], Rows], **settings: str) -> Path:
    """Write a survey of 20 points in 6 photographs, with its table and its settings changed."""
    path = write_observed_survey(folder / "s", "implausible")
    table = path.parent / "image_points.csv"
    header, *lines = table.read_text(encoding="utf-8").splitlines()
    rows = change([line.split(",") for line in lines])
    table.write_text("\n".join((header, *map(",".join, rows))) + "\n", encoding="utf-8")
    text = path.read_text(encoding="utf-8")
    for key, value in settings.items():
        (old,) = [line for line in text.splitlines() if line.startswith(f"{key} = ")]
        text = text.replace(old, f"{key} = {value}")
    path.write_text(text, encoding="utf-8")
    return path


def spread(rows: Rows) -> Rows:
    """Return the rows with points up to all borders of the photographs."""
    corners = [(0.0, 0.0), (SIZE_PX[0] - 1.0, 0.0), (SIZE_PX[0] - 1.0, SIZE_PX[1] - 1.0)]
    places = np.linspace(0, 1, len(rows))
    out = []
    for k, (image, point, _, _) in enumerate(rows):
        x, y = corners[k] if k < 3 else (places[k] * (SIZE_PX[0] - 1), places[-k] * (SIZE_PX[1] - 1))
        out.append([image, point, repr(float(x)), repr(float(y))])
    return out


def refused(path: Path, match: str) -> None:
    with pytest.raises(SurveyFileError, match=match) as error:
        measurements_from_observations(read_survey(path))
    assert "\n" not in str(error.value)


def test_exchanged_x_and_y_are_named(tmp_path: Path) -> None:
    refused(
        rewritten(tmp_path, lambda rows: [[i, p, y, x] for i, p, x, y in spread(rows)]),
        "with x and y exchanged",
    )


def test_an_exchanged_size_is_named(tmp_path: Path) -> None:
    refused(rewritten(tmp_path, spread, size_px=f"[{SIZE_PX[1]}, {SIZE_PX[0]}]"), "with x and y exchanged")


def test_a_halved_size_is_named(tmp_path: Path) -> None:
    size = f"[{SIZE_PX[0] // 2}, {SIZE_PX[1] // 2}]"
    refused(
        rewritten(tmp_path, spread, size_px=size), f"size_px must be {SIZE_PX[0] - 1} x {SIZE_PX[1] - 1} or"
    )


def test_another_unit_is_named(tmp_path: Path) -> None:
    def in_mm(rows: Rows) -> Rows:
        xy = np.array([[float(x), float(y)] for *_, x, y in rows])
        mm = image_from_pixel(xy, SIZE_PX, np.array(PIXEL_MM))
        return [[*row[:2], repr(x), repr(y)] for row, (x, y) in zip(rows, mm.tolist(), strict=True)]

    refused(rewritten(tmp_path, in_mm), "read as mm in place of px")
    path = rewritten(tmp_path / "px", lambda rows: rows)
    table = path.parent / "image_points.csv"
    table.write_text(table.read_text().replace("x_px,y_px", "x_mm,y_mm"), encoding="utf-8")
    refused(path, "read as px in place of mm")


def test_single_points_outside_are_left_out_by_name(tmp_path: Path) -> None:
    found = measurements_from_observations(
        read_survey(rewritten(tmp_path, lambda rows: [*rows, ["image 1", "new", "250000", "12"]]))
    )
    assert kinds_of(found.remarks) == ("image_points_outside",)
    assert found.remarks[0].names("image_points") == ("new in image 1",)
    assert [one.point for one in found.left_out] == ["new in image 1"]
    assert len(found.network.image_points) == len(found.network.image_points.xy) > 100


@pytest.mark.parametrize(("share", "is_refused"), [(0.5, False), (2.0, True)])
def test_the_share_of_gross_errors_that_is_left_out(tmp_path: Path, share: float, is_refused: bool) -> None:
    def change(rows: Rows) -> Rows:
        count = int(share * MAX_OUTSIDE * len(rows))
        return [[*row[:2], "-40", row[3]] if k < count else row for k, row in enumerate(rows)]

    path = rewritten(tmp_path, change)
    if is_refused:
        refused(path, "is outside its photograph")
    else:
        assert measurements_from_observations(read_survey(path)).left_out


def test_the_border_of_the_photograph() -> None:
    size = np.tile([100.0, 50.0], (4, 1))
    inside = np.array([[-0.5, 0.0], [99.5, 49.5], [-0.5 - MARGIN_PX, 3], [99.5 + MARGIN_PX, 3]])
    assert not outside_photograph(inside, size).any() and MARGIN_PX == 1.0
    assert outside_photograph(inside + np.array([[-1.1, 0], [0, 1.1], [-0.1, 0], [0.1, 0]]), size).all()


@pytest.mark.parametrize(
    ("settings", "likely"),
    [
        ({"pixel_mm": "[5, 5]"}, "pixel_mm in µm"),
        ({"c_mm": "0.024"}, "c_mm in m"),
        ({"c_mm": "24000.0"}, "c_mm in µm"),
        ({"pixel_mm": "[5e-6, 5e-6]"}, "pixel_mm in m"),
    ],
)
def test_a_field_of_view_that_no_lens_has_is_refused(
    tmp_path: Path, settings: dict[str, str], likely: str
) -> None:
    refused(rewritten(tmp_path, lambda rows: rows, **settings), f"expected 0.5 to 170; .*{likely}")


@pytest.mark.parametrize(("c_mm", "is_refused"), [(0.4, True), (0.8, False), (1100.0, False), (2000.0, True)])
def test_the_limits_of_the_field_of_view(tmp_path: Path, c_mm: float, is_refused: bool) -> None:
    """12.5 mm of a diagonal: 170 degrees at 0.55 mm, 0.5 degrees at 1432 mm."""
    path = rewritten(tmp_path, lambda rows: rows, c_mm=repr(c_mm))
    if is_refused:
        refused(path, "field of view")
    else:
        measurements_from_observations(read_survey(path))
