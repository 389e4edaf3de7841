"""Points of texture have the colours of the photographs, in scene, points.ply and COLMAP model."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pycolmap
import pytest

from adapters.colmap.camera_models import write_model
from sfm.adjustment.datum import Datum
from sfm.adjustment.result import Adjustment
from sfm.adjustment.solve import adjust
from sfm.judgement.survey_result import PhotographTargets
from sfm.model.conventions import AnyArray
from sfm.model.network import Source
from sfm.report.figures.point_colours import photographed_colours
from sfm.report.tables.csv_files import write_tables
from sfm.report.viewer.embedded import scene_of_result
from tests.findings import findings_of
from tests.report.test_statistics import result_of
from tests.synthetic import make_network, seed_of

TEXTURE = Source("texture", names_last=False, is_matched=True)
GREY = (128, 128, 128)


@pytest.fixture(scope="module")
def a() -> Adjustment:
    """Twelve points, the first of which is a target in one photograph, and one point with a rejected ray."""
    network, truth = make_network(seed_of("colours"), images=7, points=12, model="opencv")
    source = (network.image_points.point > 0).astype(np.int64)
    network = replace(
        network,
        image_points=replace(network.image_points, source=source),
        sources=(Source("targets"), TEXTURE),
    )
    return adjust(network, truth, datum=Datum("free"))


def colours_of_points(count: int) -> AnyArray:
    return seed_of("palette").integers(30, 225, (count, 3)).astype(np.uint8)


def photographs_of(a: Adjustment, folder: Path, shades: AnyArray) -> list[PhotographTargets]:
    """Write photographs with a disc of its colour at each image point, black and unreadable ones last."""
    empty, photographs = np.zeros((0, 2)), []
    seen, images = a.network.image_points, a.network.images
    for i, name in enumerate(images):
        width, height = a.estimate.cameras[0].size_px
        picture = np.zeros((height, width, 3), np.uint8)
        for k in np.flatnonzero(seen.image == i).tolist() if i < len(images) - 2 else ():
            shade = shades[seen.point[k]][::-1].tolist()
            cv2.circle(picture, np.rint(seen.xy[k]).astype(int).tolist(), 9, shade, -1)
        path = folder / f"{name}.png"
        cv2.imencode(".png", picture)[1].tofile(path)
        if i == len(images) - 1:
            path.write_bytes(b"")
        none = np.zeros(0)
        photographs.append(PhotographTargets(name, path, empty, empty, none, empty, none.astype(np.int64)))
    return photographs


def test_colours_are_medians_of_the_photographs(a: Adjustment, tmp_path: Path) -> None:
    """One of seven photographs is black, one cannot be read."""
    shades = colours_of_points(12)
    colours = photographed_colours(photographs_of(a, tmp_path, shades), a, jobs=2)
    assert colours is not None and colours.dtype == np.uint8
    assert np.abs(colours.astype(int) - shades).max() <= 1
    assert (photographed_colours([], a) == GREY).all()


def test_targets_alone_read_no_photographs(a: Adjustment, tmp_path: Path) -> None:
    alone = replace(a.network, sources=(Source("targets"), Source("given")))
    photographs = photographs_of(a, tmp_path, colours_of_points(12))
    assert photographed_colours(photographs, replace(a, network=alone)) is None


def test_scene_table_and_model_have_the_colours(a: Adjustment, tmp_path: Path) -> None:
    """A target keeps the colour that says whether it has a code, in the table of points."""
    shades, findings = colours_of_points(12), findings_of(result_of(a))
    colour = scene_of_result(findings, shades).colour
    assert colour is not None and (colour == shades).all()
    assert scene_of_result(findings).colour is None
    write_tables(findings, tmp_path, shades)
    lines = (tmp_path / "points.ply").read_text(encoding="ascii").splitlines()
    written = [tuple(map(int, line.split()[-3:])) for line in lines[lines.index("end_header") + 1 :]]
    assert written[1:] == [tuple(shade) for shade in shades[1:].tolist()]
    assert written[0] not in map(tuple, shades.tolist())
    write_model(tmp_path / "model", a.network, a.estimate, colours=shades)
    model = pycolmap.Reconstruction(str(tmp_path / "model"))
    assert [tuple(model.points3D[j + 1].color) for j in range(12)] == list(map(tuple, shades.tolist()))
