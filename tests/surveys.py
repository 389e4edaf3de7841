"""Small survey folders for the tests: rendered photographs of coded targets, or image points."""

from __future__ import annotations

from functools import lru_cache
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from sfm.judgement.survey_result import SurveyResult
from sfm.model.camera import Camera, camera_from_values
from sfm.model.conventions import AnyArray, FloatArray, angles_from_rotation
from sfm.model.estimate import Estimate
from sfm.model.network import Network
from sfm.model.remarks.catalogue import given_values
from sfm.model.remarks.remark import Remark
from sfm.products.rendering.render import render_photographs
from sfm.products.rendering.scene import CircularTargets, Faces, Marks, Optics, Scene, coded_ring, join_marks
from sfm.survey.inputs.given_values import KnownPoints, Observations, StartOrientations
from sfm.survey.inputs.survey import CameraSetup, Survey
from sfm.targets.codes.plates import code_family
from sfm.targets.codes.rings import CodeFamily
from tests.synthetic import make_network, seed_of

SIZE_PX = (640, 480)
PIXEL_MM = 0.01
C_MM = 8.0
NOISE = 2.0  # standard deviation of the intensities, of 255

SURVEY = """\
[survey]
name = "{name}"
unit = "mm"
[[camera]]
name = "small"
images = "*.png"
pixel_mm = [0.01, 0.01]
c_mm = 8.0
free = ["c"]
[targets]
polarity = "dark"
codes = "ring14"
[compare]
backend = "{backend}"
"""

CAMERA = """\
name = "synthetic"
size_px = [2000, 1500]
pixel_mm = [0.005, 0.005]
c_mm = 10.0
free = ["c"]
fixed = {x0 = 0.03, y0 = -0.02, K1 = 8e-4, K2 = -4e-6, P1 = 3e-5, P2 = -2e-5, b1 = 2e-4}
"""


def observed_text(
    name: str, unit: str, camera: str = CAMERA, *, further: str = "", backend: str = "none"
) -> str:
    """Return the text of a survey of image points; `camera` has the keys of its only camera."""
    return f"""\
[survey]
name = "{name}"
unit = "{unit}"
[[camera]]
{camera}
[observations]
file = "image_points.csv"
{further}
[compare]
backend = "{backend}"
"""


def write_photograph_survey(
    folder: Path, name: str, *, photographs: int = 6, backend: str = "none", suffix: str = ".png"
) -> Path:
    """Write a survey of rendered photographs, with noise that depends on the name; return its file."""
    folder.mkdir(parents=True)
    rng = seed_of(name)
    for number, picture in enumerate(pictures()[:photographs], 1):
        noisy = np.rint(picture + NOISE * rng.standard_normal(picture.shape))
        grey = np.clip(noisy, 0, 255).astype(np.uint8)
        cv2.imwrite(str(folder / f"photo {number}{suffix}"), grey, [cv2.IMWRITE_PNG_COMPRESSION, 1])
    path = folder / "survey.toml"
    text = SURVEY.format(name=name, backend=backend).replace("*.png", f"*{suffix}")
    path.write_text(text, encoding="utf-8")
    return path


def write_observed_survey(
    folder: Path, name: str, *, images: int = 6, points: int = 20, backend: str = "none"
) -> Path:
    """Write a survey of synthetic image points, a network that depends on the name; return its file."""
    folder.mkdir(parents=True)
    network, _ = make_network(seed_of(name), images=images, points=points, free=("c",))
    write_image_points(network, folder / "image_points.csv")
    path = folder / "survey.toml"
    path.write_text(observed_text(name, "m", backend=backend), encoding="utf-8")
    return path


def write_image_points(network: Network, file: Path) -> None:
    """Write the image points of a network as the table of a survey."""
    seen = network.image_points
    lines = ["image,point,x_px,y_px"]
    lines += [
        f"{network.images[i]},{network.points[j]},{x!r},{y!r}"
        for i, j, (x, y) in zip(seen.image, seen.point, seen.xy.tolist(), strict=True)
    ]
    file.write_text("\n".join(lines) + "\n", encoding="utf-8")


@lru_cache
def pictures() -> tuple[AnyArray, ...]:
    """Render six convergent photographs of two plates with coded targets, without noise."""
    positions, rotations = stations(6)
    optics = Optics(blur_px=0.7, exposure=0.9)
    found, _ = render_photographs(plates(), camera(), positions, rotations, optics=optics, seed=1)
    return tuple(found)


def camera() -> Camera:
    """Return the camera of the rendered photographs."""
    return camera_from_values("small", "brown", SIZE_PX, (PIXEL_MM, PIXEL_MM), c_mm=C_MM)


def stations(count: int) -> tuple[FloatArray, FloatArray]:
    """Return positions and rotations of cameras on a ring, 500 mm above the plates, rolled by turns."""
    azimuth = 2 * np.pi * np.arange(count) / count
    position = np.stack([330 * np.cos(azimuth), 330 * np.sin(azimuth), np.full(count, 520.0)], axis=1)
    rotation = np.empty((count, 3, 3))
    for i in range(count):
        z = position[i] / np.linalg.norm(position[i])
        x = np.cross([0.0, 0.0, 1.0], z)
        x /= np.linalg.norm(x)
        turn = np.pi / 2 * (i % 4)
        roll = np.array([[np.cos(turn), -np.sin(turn), 0], [np.sin(turn), np.cos(turn), 0], [0, 0, 1]])
        rotation[i] = np.stack([x, np.cross(z, x), z], axis=1) @ roll
    return position, rotation


def code_centres() -> dict[int, FloatArray]:
    """Return where the codes of the rendered photographs are by number, mm."""
    scene = plates()
    height = np.array([0.0, 60.0])
    return {
        int(code): np.array([*xy, height[face]])
        for code, face, xy in zip(scene.targets.code, scene.targets.face, scene.targets.centre, strict=True)
    }


def plates() -> Scene:
    """Return two plates with coded targets, one 60 mm above the other, mm."""
    family = code_family("ring14")
    assert isinstance(family, CodeFamily)
    axes = np.tile(np.eye(3)[:2], (2, 1, 1))
    faces = Faces(
        np.array([[0.0, 0.0, 0.0], [0.0, 0.0, 60.0]]),
        axes,
        np.array([[210.0, 160.0], [60.0, 50.0]]),
        np.array([0.8, 0.85]),
        np.zeros(2),
        np.ones(2),
    )
    marks: list[Marks] = []
    places: list[tuple[int, float, float]] = [
        (0, x, y) for x in (-165.0, -105.0, 105.0, 165.0) for y in (-115.0, 0.0, 115.0)
    ]
    places += [(0, x, y) for x in (-35.0, 35.0) for y in (-120.0, 120.0)]
    places += [(1, x, y) for x in (-32.0, 32.0) for y in (-25.0, 25.0)]
    for k, (face, x, y) in enumerate(places):
        marks.append(coded_ring(face, np.array([x, y]), 7.0, 5 + 3 * k, family, 0.08, turn=0.3 * k))
    where = np.array(places)
    targets = CircularTargets(
        where[:, 0].astype(np.int64),
        where[:, 1:],
        np.full(len(places), 7.0),
        5 + 3 * np.arange(len(places)),
    )
    return Scene(faces, join_marks(marks), targets)


def remarks_on_given(result: SurveyResult) -> tuple[Remark, ...]:
    """Return what a survey found of its scale bars, control and orientation before the adjustment."""
    kinds = {row.name for row in given_values.ROWS} | {"scale_unchecked"}
    kinds |= {f"given_{how}_checked" for how in ("partly", "weakly")} | {"given_unchecked"}
    return tuple(one for one in (*result.remarks, *result.tests) if one.kind in kinds)


def survey_of(
    network: Network,
    truth: Estimate,
    *,
    name: str = "observed",
    free: tuple[str, ...] = ("c",),
    start: Estimate | None = None,
    sigma: bool = False,
    **given: Any,
) -> Survey:
    """Return a survey of the image points of a synthetic network with one camera.

    Args:
        network: gives names and image points.
        truth: gives the camera: what is not free is fixed at its value.
        name: of the survey.
        free: parameters that are adjusted, from 0 but for c.
        start: approximate values of photographs and points, those that are not NaN; none if not given.
        sigma: whether the image points state their standard deviations.
        given: further arguments of Survey.
    """
    seen, camera = network.image_points, truth.cameras[0]
    fixed = {
        n: float(v) for n, v in zip(camera.names, camera.parameters, strict=True) if n not in (*free, "c")
    }
    settings: dict[str, Any] = {
        "name": "synthetic",
        "size_px": camera.size_px,
        "pixel_mm": tuple(camera.pixel_mm.tolist()),
        "model": camera.model,
        "free": free,
        "fixed": fixed,
        "c_mm": camera.value("c"),
    }
    if start is not None:
        images, points = np.flatnonzero(start.oriented), np.flatnonzero(start.determined)
        if len(images):
            angles = np.degrees([angles_from_rotation(start.rotation[i]) for i in images])
            names = [network.images[i] for i in images]
            given["start_orientations"] = StartOrientations.from_arrays(names, start.position[images], angles)
        if len(points):
            names = [network.points[j] for j in points]
            given["start_points"] = KnownPoints.from_arrays(names, start.points[points])
    observations = Observations.from_arrays(
        [network.images[i] for i in seen.image],
        [network.points[j] for j in seen.point],
        seen.xy,
        np.sqrt(np.diagonal(seen.covariance, axis1=1, axis2=2)) if sigma else None,
    )
    return Survey(name=name, cameras=(CameraSetup(**settings),), observations=observations, **given)
