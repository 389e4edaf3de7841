"""Tables of a result: written and read by the columns that are stated once."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from sfm.errors import SurveyFileError
from sfm.files.result_tables import CONTROL_POINTS, IMAGE_POINTS, POINTS, ResultTable

NAMES = ("image 1", "image 2"), ("A", "=B")
XY = np.array([[0.1, 2.0], [1 / 3, 4.0]])


def test_groups_that_are_not_known_are_left_out_and_read_as_unknown(tmp_path: Path) -> None:
    IMAGE_POINTS.write(tmp_path, NAMES, XY, None, None, None, None)
    table = IMAGE_POINTS.read(tmp_path)
    assert table.texts == NAMES and (table.part(("x_px", "y_px")) == XY).all()
    assert np.isnan(table.part(("sx_px", "cxy_px2", "rejected"))).all()
    sigma = np.array([[0.1, np.nan], [0.3, 0.4]])
    IMAGE_POINTS.write(tmp_path, NAMES, XY, sigma, [None, 0.01], XY, [0, 1])
    table = IMAGE_POINTS.read(tmp_path)
    np.testing.assert_array_equal(table.part(("sx_px", "sy_px")), sigma)
    assert np.isnan(table.part(("cxy_px2",))[0, 0]) and table.part(("cxy_px2",))[1, 0] == 0.01
    assert table.part(("rejected",)).ravel().tolist() == [0, 1]
    assert np.isnan(table.part(("vx_px",))).all()  # of the residuals nothing is read


def test_a_covariance_without_its_standard_deviations_is_passed_over(tmp_path: Path) -> None:
    (tmp_path / IMAGE_POINTS.file).write_text("image,point,x_px,y_px,cxy_px2\na,b,1,2,3\n")
    assert np.isnan(IMAGE_POINTS.read(tmp_path).part(("cxy_px2",))).all()


def test_columns_that_may_be_empty_must_be_there(tmp_path: Path) -> None:
    (tmp_path / CONTROL_POINTS.file).write_text("use,point,coordinate,given,sigma_prior\ncheck,1,X,,\n")
    assert np.isnan(CONTROL_POINTS.read(tmp_path).values).all()
    (tmp_path / CONTROL_POINTS.file).write_text("use,point,coordinate,given\ncheck,1,X,2\n")
    with pytest.raises(SurveyFileError, match="no column sigma_prior"):
        CONTROL_POINTS.read(tmp_path)


def test_an_empty_table_has_its_header(tmp_path: Path) -> None:
    POINTS.write(tmp_path, (), np.zeros((0, 3)), np.zeros((0, 3)), [])
    assert (tmp_path / POINTS.file).read_text() == ",".join(POINTS.names_of()) + "\n"


def test_values_that_do_not_fit_are_refused(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="2 columns of values for 3"):
        POINTS.write(tmp_path, ("A", "B"), XY, None, None)
    with pytest.raises(ValueError, match="expected one of name, number"):
        ResultTable("points", "names: id")
