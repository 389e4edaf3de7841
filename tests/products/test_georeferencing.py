"""Georeferencing of one photograph: transformations, the picture in the plane, and the command."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import ExifTags, Image

from sfm.model.conventions import AnyArray, FloatArray
from sfm.model.errors import GeometryError
from sfm.products.georeferencing.transformation import MODELS, fit_plane
from tests.commands import kolinear, refused
from tests.synthetic import seed_of

SIZE = (1200, 900)
ORIGIN = np.array([689_000.0, 9_120_000.0])  # of the plane, m
TO_PIXEL = np.array([[38.0, 4.0, 260.0], [-3.0, -36.0, 760.0], [0.004, 0.006, 1.0]])  # of metres from it


def pixels_of(plane: FloatArray) -> FloatArray:
    """Return the pixels of points of the plane, by the true projection."""
    h = np.column_stack([plane - ORIGIN, np.ones(len(plane))]) @ TO_PIXEL.T
    return np.asarray(h[:, :2] / h[:, 2:])


def control(count: int, noise: float, *, seed: str = "plane") -> tuple[FloatArray, FloatArray]:
    rng = seed_of(seed)
    xy = ORIGIN + rng.uniform([0.0, 0.0], [20.0, 18.0], (count, 2))
    return xy, pixels_of(xy) + noise * rng.standard_normal((count, 2))


def write_control(path: Path, xy: FloatArray, places: FloatArray) -> Path:
    rows = [f"{k},{x!r},{y!r},{X!r},{Y!r}" for k, (x, y, X, Y) in enumerate(np.hstack([places, xy]).tolist())]
    path.write_text("point,x_px,y_px,X,Y\n" + "\n".join(rows) + "\n", encoding="utf-8")
    return path


def photograph() -> tuple[AnyArray, FloatArray]:
    """Return a photograph with a dot at each of nine places of the plane, and these places."""
    places = ORIGIN + np.stack(np.meshgrid([4.0, 10.0, 16.0], [3.0, 9.0, 15.0]), axis=-1).reshape(-1, 2)
    picture = np.full((SIZE[1], SIZE[0], 3), 60, np.uint8)
    y, x = np.mgrid[: SIZE[1], : SIZE[0]]
    for at in pixels_of(places):
        disc = np.clip(8.5 - np.hypot(x - at[0], y - at[1]), 0, 1)
        picture = np.maximum(picture, (60 + 180 * disc[..., None] * [1.0, 0.6, 0.3]).astype(np.uint8))
    return picture, places


@pytest.mark.parametrize("model", MODELS)
def test_what_follows_a_model_is_recovered(model: str) -> None:
    """Exact points give the transformation everywhere, and no residual."""
    rng = seed_of(f"georeferencing {model}")
    xy = ORIGIN + rng.uniform(0, 20, (14, 2))
    if model == "projective":
        true = pixels_of
    else:
        degree = {"affine": 1, "polynomial2": 2, "polynomial3": 3}[model]
        powers = [(a, b) for a in range(degree + 1) for b in range(degree + 1 - a)]
        factors = rng.normal(0, 30, (2, len(powers)))

        def true(plane: FloatArray) -> FloatArray:
            x, y = ((plane - ORIGIN) / 20.0).T
            return np.asarray((factors @ np.array([x**a * y**b for a, b in powers])).T)

    fit = fit_plane(xy, true(xy), model=model)
    other = ORIGIN + rng.uniform(0, 20, (50, 2))
    assert np.abs(fit.apply(other) - true(other)).max() < 1e-6
    assert fit.sigma0 < 1e-7 and fit.redundancy == 28 - MODELS[model].unknowns
    assert fit.predicted_rms < 1e-6


def test_what_is_stated_is_what_is_reached() -> None:
    """Over many sets of points: sigma0 is the noise, and each point is predicted as well as others are."""
    sigma0, predicted, reached = [], [], []
    for k in range(60):
        xy, places = control(9, 0.4, seed=f"plane {k}")
        fit = fit_plane(xy, places)
        inside = xy.mean(axis=0) + 0.5 * (xy - xy.mean(axis=0))
        sigma0.append(fit.sigma0**2)
        predicted.append(fit.predicted_rms**2)
        reached.append(np.mean((fit.apply(inside) - pixels_of(inside)) ** 2))
    assert np.sqrt(np.mean(sigma0)) == pytest.approx(0.4, rel=0.06)
    assert np.sqrt(np.mean(reached)) < 0.4 < np.sqrt(np.mean(predicted))


def test_the_size_of_a_pixel_is_that_of_the_area_it_covers() -> None:
    xy, places = control(8, 0.0)
    fit = fit_plane(xy, places)
    corner = np.array([[-0.5, -0.5], [0.5, -0.5], [0.5, 0.5], [-0.5, 0.5]])
    at = places[3] + corner
    H = np.linalg.inv(TO_PIXEL)
    h = np.column_stack([at, np.ones(4)]) @ H.T
    x, y = (h[:, :2] / h[:, 2:]).T
    area = abs(np.dot(x, np.roll(y, 1)) - np.dot(y, np.roll(x, 1))) / 2
    assert fit.pixel_size(xy)[3] == pytest.approx(np.sqrt(area), rel=1e-3)


def test_points_that_determine_nothing_are_refused() -> None:
    xy, places = control(9, 0.1)
    with pytest.raises(GeometryError, match="3 control points, projective needs at least 4"):
        fit_plane(xy[:3], places[:3])
    line = ORIGIN + np.outer(np.arange(6.0), [1.0, 2.0])
    with pytest.raises(GeometryError, match="coincide or lie on one line"):
        fit_plane(line, pixels_of(line))
    mostly = np.vstack([line[:5], np.add(ORIGIN, (4.0, 1.0))])
    with pytest.raises(GeometryError, match="do not determine projective"):
        fit_plane(mostly, pixels_of(mostly))
    with pytest.raises(GeometryError, match="model 'spline', expected one of"):
        fit_plane(xy, places, model="spline")


@pytest.mark.parametrize("ending", ["png", "tif", "jpg"])
def test_dots_are_where_the_world_file_says(
    ending: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    picture, places = photograph()
    cv2.imwrite(str(tmp_path / "a.png"), picture)
    table = write_control(tmp_path / "control.csv", *control(10, 0.0))
    out = tmp_path / f"map.{ending}"
    extent = "689000.5,9120000,689019.5,9120018"
    assert (
        kolinear(
            *("georeference", tmp_path / "a.png", table, "--out", out, "--pixel", 0.02, "--extent", extent)
        )
        == 0
    )
    shown = capsys.readouterr().out
    assert "projective transformation, 10 control points" in shown and f"Picture: {out}" in shown
    world = next(tmp_path.glob("map.?gw" if ending != "tif" else "map.tfw"))
    a, d, b, e, X0, Y0 = map(float, world.read_text().split())
    assert (a, d, b, e) == (0.02, 0.0, 0.0, -0.02)
    drawn = cv2.imread(str(out), cv2.IMREAD_UNCHANGED)
    if ending != "jpg":
        assert drawn.shape[2] == 4 and set(np.unique(drawn[..., 3])) <= {0, 255}
    for X, Y in places:
        x, y = (X - X0) / a, (Y - Y0) / e
        part = drawn[round(y) - 40 : round(y) + 41, round(x) - 40 : round(x) + 41, 0].astype(float) - 60
        part[part < 25] = 0.0
        rows, columns = np.mgrid[:81, :81]
        off = (
            np.array([(columns * part).sum(), (rows * part).sum()]) / part.sum()
            + [round(x), round(y)]
            - [x, y]
            - 40
        )
        assert np.abs(off).max() < 0.25  # of the squares; the dot's middle is not that of its image
        blue, green, red = drawn[round(y), round(x), :3]
        assert blue > green > red  # as in the photograph


def test_a_model_that_predicts_far_better_is_named(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """A photograph of a plane under an affine transformation, and the other way round."""
    cv2.imwrite(str(tmp_path / "a.png"), photograph()[0])
    table = write_control(tmp_path / "control.csv", *control(12, 0.1))
    assert (
        kolinear("georeference", tmp_path / "a.png", table, "--out", tmp_path / "m.png", "--model", "affine")
        == 0
    )
    shown = capsys.readouterr().out
    assert "times better: --model projective" in shown and "predicted from the others" in shown
    assert kolinear("georeference", tmp_path / "a.png", table, "--out", tmp_path / "n.png") == 0
    assert "times better" not in capsys.readouterr().out


def test_the_coordinate_system_is_written(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    cv2.imwrite(str(tmp_path / "a.png"), photograph()[0])
    table = write_control(tmp_path / "control.csv", *control(6, 0.1))
    out = tmp_path / "m.tif"
    assert kolinear("georeference", tmp_path / "a.png", table, "--out", out, "--crs", "EPSG:32749") == 0
    assert "WGS_1984_UTM_Zone_49S" in out.with_suffix(".prj").read_text()
    capsys.readouterr()
    told = refused(
        capsys, "georeference", tmp_path / "a.png", table, "--out", tmp_path / "n.tif", "--crs", "49S"
    )
    assert "--crs '49S': not a known coordinate system" in told
    assert not (tmp_path / "n.tif").exists()


def test_bad_input_gets_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    cv2.imwrite(str(tmp_path / "a.png"), photograph()[0])
    table = write_control(tmp_path / "control.csv", *control(6, 0.1))
    taken = tmp_path / "taken.pgw"
    taken.write_text("mine")
    for told, out, *further in (
        ("expected a file .png", "map.gif"),
        ("expected X0,Y0,X1,Y1", "map.png", "--extent", "1,2,3"),
        ("the extent is empty", "map.png", "--extent", "5,5,1,1"),
        ("larger pixels or a smaller extent", "map.png", "--pixel", "1e-6"),
        ("the extent is empty", "map.png", "--pixel", "-1"),
        ("the extent is empty or has no end", "map.png", "--pixel", "inf"),
        ("the extent is empty or has no end", "map.png", "--extent", "0,0,inf,1"),
        ("shows nothing of this extent", "map.png", "--extent", "0,0,10,10", "--pixel", "1"),
        ("exists already", "taken.png"),
        ("6 control points, polynomial3 needs at least 10", "map.png", "--model", "polynomial3"),
    ):
        assert told in refused(
            capsys, "georeference", tmp_path / "a.png", table, "--out", tmp_path / out, *further
        )
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a.png", "control.csv", "taken.pgw"]
    assert taken.read_text() == "mine"


def test_a_picture_may_be_wider_than_opencv_resamples(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """It is resampled in blocks; what a format cannot hold is refused."""
    cv2.imwrite(str(tmp_path / "a.png"), photograph()[0])
    table = write_control(tmp_path / "control.csv", *control(10, 0.0))
    wide = ("--pixel", 0.0005, "--extent", "688999,9120009,689034,9120009.01")
    assert kolinear("georeference", tmp_path / "a.png", table, "--out", tmp_path / "m.png", *wide) == 0
    drawn = cv2.imread(str(tmp_path / "m.png"), cv2.IMREAD_UNCHANGED)
    assert drawn.shape == (20, 70_000, 4)
    dots = np.flatnonzero(drawn[10, :, 0] > 120)
    places = [
        688_999 + 0.0005 * part.mean() for part in np.split(dots, np.flatnonzero(np.diff(dots) > 9) + 1)
    ]
    assert places == pytest.approx([689_004.0, 689_010.0, 689_016.0], abs=0.05)
    capsys.readouterr()
    told = refused(capsys, "georeference", tmp_path / "a.png", table, "--out", tmp_path / "m.jpg", *wide)
    assert "cannot be encoded as .jpg, 70000 x 20 pixels" in told and not list(tmp_path.glob("*.jgw"))


def test_points_outside_and_mirrored_ones_are_said(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    cv2.imwrite(str(tmp_path / "a.png"), photograph()[0])
    xy, places = control(10, 0.1)
    far = write_control(tmp_path / "far.csv", xy, np.add(places, (SIZE[0], 0)))
    told = refused(capsys, "georeference", tmp_path / "a.png", far, "--out", tmp_path / "f.png")
    assert "control points outside the photograph of 1200 x 900 pixels: 0, 1" in told
    right = write_control(tmp_path / "control.csv", xy, places)
    exchanged = write_control(tmp_path / "exchanged.csv", xy[:, ::-1], places)
    for table, is_mirrored in ((right, False), (exchanged, True)):
        out = tmp_path / f"{table.stem}.png"
        assert kolinear("georeference", tmp_path / "a.png", table, "--out", out) == 0
        assert ("is drawn mirrored" in capsys.readouterr().out) == is_mirrored


def test_a_photograph_that_viewers_turn_is_said(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Pixels count as stored; points measured in a viewer that turns are often outside."""
    exif = Image.Exif()
    exif[ExifTags.Base.Orientation] = 6
    path = tmp_path / "a.jpg"
    Image.fromarray(photograph()[0]).save(path, exif=exif)
    xy = np.vstack([control(10, 0.0)[0], np.add(ORIGIN, (26.0, 5.0))])
    places = pixels_of(xy)
    table = write_control(tmp_path / "control.csv", xy, places)
    assert kolinear("georeference", path, table, "--out", tmp_path / "m.png") == 0
    assert "viewers turn this photograph by its EXIF data" in capsys.readouterr().out
    turned = write_control(tmp_path / "turned.csv", xy, np.column_stack([899 - places[:, 1], places[:, 0]]))
    told = refused(capsys, "georeference", path, turned, "--out", tmp_path / "n.png")
    assert "which viewers turn by its EXIF data: " in told
