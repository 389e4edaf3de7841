"""A plan as a survey to be run: read from its folder, rendered, compared with what the survey achieved."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import numpy as np
from pydantic import Field

from sfm.camera import Camera
from sfm.conventions import BoolArray, FloatArray, IntArray, rotation_from_angles
from sfm.display import counted
from sfm.distortion.models import MODELS
from sfm.errors import SurveyFileError
from sfm.files.csv_tables import read_table
from sfm.files.json_files import Content, Name, Text, read_json
from sfm.files.open_folders import refuse_links_out
from sfm.planning.stations import Stations
from sfm.rendering.planned_targets import INK, PAPER, write_planned_photographs
from sfm.rendering.scene import UNCODED, Optics
from sfm.similarity import fit_similarity
from sfm.solution import Solution
from sfm.targets.codes.families import code_family
from sfm.targets.codes.rings import CodeFamily

MAX_PIXELS = 70_000_000  # of a simulated photograph: they are drawn whole, with oversampling
NEAR = 0.3  # of the distance of neighbours within which a measured point is a planned one
Positive = Annotated[float, Field(gt=0, lt=1e12)]


class _Target(Content):
    diameter: Positive | None
    diameter_for_7_px: Positive
    contrast: Positive
    noise: Positive
    blur_px: Positive


class _Camera(Content):
    name: Name
    model: Name
    size_px: tuple[int, int]
    pixel_mm: tuple[Positive, Positive]
    parameters: dict[str, float]
    free: list[str]


class _Plan(Content):
    name: Text
    unit: Text
    sigma_px: Positive
    scale_bars: Annotated[int, Field(ge=0)] = 0
    target: _Target
    cameras: list[_Camera]


@dataclass(frozen=True)
class PlannedSurvey:
    """A plan as its folder holds it."""

    name: str
    unit: str
    camera: Camera
    stations: Stations
    points: tuple[str, ...]
    xyz: FloatArray  # object unit, (n, 3)
    normals: FloatArray  # (n, 3)
    sigma: FloatArray  # predicted, of X, Y, Z, object unit; NaN where not determined, (n, 3)
    coded: BoolArray  # (n,)
    seen: BoolArray  # which photograph shows which point, (m, n)
    diameter: float  # of targets, object unit
    contrast: float
    noise: float
    blur_px: float
    sigma_px: float  # of an image coordinate, as the prediction has it


@dataclass(frozen=True)
class Achieved:
    """Precision that a simulated survey achieved, against the prediction of its plan."""

    points: int  # planned points that were measured
    planned: int
    ratio: float  # median of a posteriori over predicted sigmas of points
    error: float  # RMS error against the truth over the predicted RMS sigma, after a similarity
    sigma_px: float  # a posteriori, of an image coordinate
    predicted_px: float


def read_plan(folder: Path) -> PlannedSurvey:
    """Read a plan from the folder that `kolinear plan network` has written.

    Raises:
        SurveyFileError: what is missing or wrong, with file and line.
    """
    refuse_links_out(folder)
    plan = read_json(folder / "plan.json", _Plan, "a plan")
    if plan.scale_bars:
        raise SurveyFileError(
            f"{folder / 'plan.json'}: planned with a scale bar, which a simulation has not, so that its "
            "standard deviations cannot be compared; plan without --scale-bar"
        )
    (c,) = plan.cameras
    if c.model not in MODELS or set(c.parameters) != set(MODELS[c.model].names):
        raise SurveyFileError(
            f"{folder / 'plan.json'}: camera {c.name} has not the parameters of a known model"
        )
    names = MODELS[c.model].names
    if not all(side > 0 for side in c.size_px) or c.size_px[0] * c.size_px[1] > MAX_PIXELS:
        raise SurveyFileError(f"{folder / 'plan.json'}: photographs of {c.size_px[0]} x {c.size_px[1]} px")
    camera = Camera(
        c.name,
        c.model,
        c.size_px,
        np.array(c.pixel_mm),
        np.array([c.parameters[name] for name in names]),
        np.array([name in c.free for name in names]),
    )
    angles = ("omega_deg", "phi_deg", "kappa_deg")
    table = read_table(folder / "exterior.csv", ("image",), ("X", "Y", "Z", *angles))
    rotation = np.array([rotation_from_angles(*np.radians(row)) for row in table.values[:, 3:]])
    stations = Stations(table.keys("image"), table.values[:, :3].copy(), rotation)
    columns = ("X", "Y", "Z", "nX", "nY", "nZ", "sX", "sY", "sZ", "coded")
    table = read_table(folder / "points.csv", ("id",), columns, ignored=None, blank=columns[3:9])
    points = table.keys("id")
    rays = read_table(folder / "image_points.csv", ("image", "point"), (), ignored=None)
    rows = {name: i for i, name in enumerate(stations.names)}
    places = {name: j for j, name in enumerate(points)}
    seen = np.zeros((len(rows), len(places)), dtype=bool)
    for line, image, point in zip(rays.line, *rays.texts, strict=True):
        if image not in rows or point not in places:
            raise SurveyFileError(
                f"{rays.path}, line {line}: image '{image}' or point '{point}' is not in the plan"
            )
        seen[rows[image], places[point]] = True
    v = table.values
    normals = v[:, 3:6].copy()
    unknown = np.isnan(normals).any(axis=1)
    if unknown.any():
        first = points[int(np.argmax(unknown))]
        raise SurveyFileError(f"{table.path}: point '{first}' has no normal; a simulation needs nX, nY, nZ")
    return PlannedSurvey(
        plan.name,
        plan.unit,
        camera,
        stations,
        points,
        v[:, :3].copy(),
        normals / np.linalg.norm(normals, axis=1, keepdims=True),
        v[:, 6:9].copy(),
        v[:, 9] > 0,
        seen,
        plan.target.diameter or plan.target.diameter_for_7_px,
        plan.target.contrast,
        plan.target.noise,
        plan.target.blur_px,
        plan.sigma_px,
    )


def codes_of(plan: PlannedSurvey, family: CodeFamily) -> IntArray:
    """Return the code number of each target, UNCODED where it has no ring, (n,).

    Raises:
        SurveyFileError: the family has fewer codes than the plan needs.
    """
    numbers = np.sort(np.asarray(family.number, dtype=np.int64))
    if plan.coded.sum() > len(numbers):
        raise SurveyFileError(
            f"simulation: {counted(plan.coded.sum(), 'coded target')}, family {family.name} "
            f"has {len(numbers)}"
        )
    code = np.full(len(plan.points), UNCODED, dtype=np.int64)
    code[plan.coded] = numbers[: plan.coded.sum()]
    return code


def write_simulation(plan: PlannedSurvey, folder: Path, *, codes: str = "ring14", seed: int = 0) -> Path:
    """Render the photographs of a plan and write the survey file that measures them; return its path.

    Args:
        plan: the plan.
        folder: that is there; photographs go into `photographs` in it.
        codes: family of the coded targets.
        seed: of the noise.

    Raises:
        KolinearError: too many codes, targets that overlap, or a file that cannot be written.
    """
    family = _rings(codes)
    exposure = plan.contrast / (255 * (PAPER - INK))
    if exposure * PAPER > 1:
        raise SurveyFileError(
            f"simulation: contrast {plan.contrast:g} of 255 grey values, at most "
            f"{255 * (1 - INK / PAPER):.0f} can be shown"
        )
    pictures = folder / "photographs"
    pictures.mkdir()
    optics = Optics(
        blur_px=float(np.sqrt(max(plan.blur_px**2 - 1 / 12, 0.04))), exposure=exposure, noise=plan.noise / 255
    )
    write_planned_photographs(
        pictures,
        tuple(f"{name}.png" for name in plan.stations.names),
        plan.camera,
        plan.stations.position,
        plan.stations.rotation,
        xyz=plan.xyz,
        normals=plan.normals,
        code=codes_of(plan, family),
        radius=plan.diameter / 2,
        seen=plan.seen,
        family=family,
        optics=optics,
        seed=seed,
    )
    camera = plan.camera
    held = [
        f"{name} = {value!r}"
        for name, value, free in zip(
            camera.names, camera.parameters.tolist(), camera.free.tolist(), strict=True
        )
        if not free and name != "c"
    ]
    text = SURVEY.format(
        unit=plan.unit,
        size=list(camera.size_px),
        pixel=camera.pixel_mm.tolist(),
        c=camera.c_px * float(np.mean(camera.pixel_mm)),
        model=camera.model,
        free=str([n for n, f in zip(camera.names, camera.free, strict=True) if f]).replace("'", '"'),
        fixed="" if not held else f"fixed = {{ {', '.join(held)} }}\n",
        codes=codes,
    )
    path = folder / "survey.toml"
    path.write_text(text, encoding="utf-8")
    return path


def _rings(codes: str) -> CodeFamily:
    family = code_family(codes)
    if not isinstance(family, CodeFamily):
        raise SurveyFileError(f"--family {codes}: needed rings, such as ring14")
    return family


SURVEY = """\
[survey]
name = "simulation"
unit = "{unit}"
[[camera]]
name = "planned"
images = "photographs/*.png"
size_px = {size}
pixel_mm = {pixel}
c_mm = {c}
model = "{model}"
free = {free}
{fixed}[targets]
polarity = "dark"
codes = "{codes}"
[datum]
kind = "free"
[compare]
backend = "none"
"""


def achieved(plan: PlannedSurvey, codes: str, result: Solution, sigma_px: float) -> Achieved:
    """Return what a simulated survey achieved against its plan.

    Args:
        plan: the plan.
        codes: family of the coded targets.
        result: of the survey.
        sigma_px: of an image coordinate, a posteriori, px.

    Raises:
        SurveyFileError: fewer than 3 coded targets were measured, which tell what is what.
    """
    code = codes_of(plan, _rings(codes))
    names = {name: j for j, name in enumerate(result.network.points)}
    xyz = result.estimate.points
    pairs = [(names[str(c)], k) for k, c in enumerate(code) if c != UNCODED and str(c) in names]
    pairs = [(j, k) for j, k in pairs if np.isfinite(xyz[j]).all()]
    if len(pairs) < 3:
        raise SurveyFileError(f"simulation: {counted(len(pairs), 'coded target')} in the result, needed 3")
    j, k = (np.array(column) for column in zip(*pairs, strict=True))
    placed = fit_similarity(xyz[j], plan.xyz[k]).apply(xyz)
    away = np.linalg.norm(plan.xyz[:, None] - placed[None], axis=2)
    apart = np.linalg.norm(plan.xyz[:, None] - plan.xyz[None], axis=2)
    np.fill_diagonal(apart, np.inf)
    nearest = np.where(np.isfinite(away), away, np.inf).argmin(axis=1)
    found = (away[np.arange(len(away)), nearest] < NEAR * apart.min(axis=1)) & np.isfinite(plan.sigma[:, 0])
    j, k = nearest[found], np.flatnonzero(found)
    motion = fit_similarity(xyz[j], plan.xyz[k])
    error = motion.apply(xyz[j]) - plan.xyz[k]
    predicted = np.sqrt((plan.sigma[k] ** 2).mean(axis=1))
    if result.point_covariance is None:
        raise SurveyFileError("simulation: the result has no standard deviations")
    sigma = motion.scale * np.sqrt(np.trace(result.point_covariance[j], axis1=1, axis2=2) / 3)
    return Achieved(
        int(found.sum()),
        len(plan.points),
        float(np.median(sigma / predicted)),
        float(np.sqrt((error**2).mean() / (predicted**2).mean())),
        sigma_px,
        plan.sigma_px,
    )
