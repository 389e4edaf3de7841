"""Simulation of a planned survey: reading the plan, rendering its photographs, checking its precision.

The simulated survey has random errors with the standard deviations of the plan. After its adjustment, the
achieved precision is compared with the prediction.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from glob import escape
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from pydantic import Field, FiniteFloat

from sfm.files.csv_tables import array_table, read_table
from sfm.files.open_folders import refuse_links_out
from sfm.files.plain_text import Content, Name, Text, csv_text, read_json
from sfm.files.result_tables import IN_FILES, MOMENTS, MOUNTS, SIGMAS, VALUES
from sfm.judgement.survey_result import SurveyResult
from sfm.model.camera import Camera
from sfm.model.conventions import BoolArray, FloatArray, IntArray, angles_from_rotation, rotation_from_angles
from sfm.model.display import counted, listed
from sfm.model.distortion.models import MODELS
from sfm.model.errors import SurveyFileError
from sfm.model.estimate import Estimate, Mounts
from sfm.model.network import ImagePoints, Network, rows_of
from sfm.model.observations.pose import MountObservations
from sfm.model.observations.tables import TABLES
from sfm.model.similarity import fit_motions, fit_similarity
from sfm.model.solution import Solution
from sfm.products.planning.prediction import simulate_network
from sfm.products.planning.stations import Stations
from sfm.products.planning.weakness import open_motions
from sfm.products.rendering.planned_targets import INK, PAPER, PlannedTargets, write_planned_photographs
from sfm.products.rendering.scene import UNCODED, Optics
from sfm.survey.observation_tables import ObservationTable, observation_table, with_tables
from sfm.targets.codes.plates import code_family
from sfm.targets.codes.rings import CodeFamily

IMAGE_POINTS = ("image", "point", "x_px", "y_px", "sx_px", "sy_px")
MAX_PIXELS = 70_000_000  # of a simulated photograph, which is drawn whole, with oversampling
MAX_NEIGHBOUR_FRACTION = 0.3  # of the distance of neighbours: limit between a measured and its planned point
Positive = Annotated[float, Field(gt=0, lt=1e12)]
Deviation = Annotated[float, Field(ge=0, lt=1e12)]


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


class _Mount(Content):
    camera: Name
    rig: Name
    value: Annotated[list[FiniteFloat], Field(min_length=6, max_length=6)]  # X, Y, Z, omega_deg, phi_deg, ...
    sigma: Annotated[list[Deviation], Field(min_length=6, max_length=6)] | None  # 0 = held; None = free


class _Plan(Content):
    name: Text
    unit: Text
    sigma_px: Positive
    scale_bars: tuple[tuple[Name, Name, Positive], ...] = ()
    survey_observations: Annotated[
        dict[Literal[tuple(TABLES)], list[list[Name | float]]],  # type: ignore[valid-type]
        Field(default_factory=dict),
    ]
    mounts: tuple[_Mount, ...] = ()
    target: _Target
    cameras: Annotated[list[_Camera], Field(min_length=1)]


@dataclass(frozen=True)
class PlannedSurvey:
    """A plan as stored in its folder."""

    name: str
    unit: str
    cameras: tuple[Camera, ...]
    stations: Stations
    points: tuple[str, ...]
    xyz: FloatArray  # object unit, (n, 3)
    normals: FloatArray  # (n, 3)
    sigma: FloatArray  # predicted, of X, Y, Z, object unit; NaN if undetermined, (n, 3)
    coded: BoolArray  # (n,)
    seen: BoolArray  # which photograph shows which point, (m, n)
    diameter: float  # of targets, object unit
    contrast: float
    noise: float
    blur_px: float
    sigma_px: float  # of an image coordinate, as in the prediction
    bars: tuple[tuple[str, str, float], ...]  # ends and standard deviation, object unit
    tables: tuple[ObservationTable, ...]
    given_mounts: MountObservations  # mounts held fixed have variance 0

    def simulated(self, seed: int) -> tuple[Network, Estimate]:
        """Return the measured network with errors, and the truth.

        Args:
            seed: seed of the errors.
        """
        i, j = np.nonzero(self.seen)
        C = np.tile(self.sigma_px**2 * np.eye(2), (len(i), 1, 1))
        stations = self.stations
        network = Network(
            stations.names,
            stations.camera,
            self.points,
            ImagePoints(i, j, np.zeros((len(i), 2)), C),
            moment=stations.taken_at,
        )
        for start, end, sigma in self.bars:
            network = network.with_scale_bar(start, end, 1.0, sigma)
        network = with_tables(self.tables, network)
        network = network.with_given(further=(*network.further, self.given_mounts))
        truth = Estimate(self.cameras, stations.position, stations.rotation, self.xyz, stations.rig)
        return simulate_network(network, truth, np.random.default_rng(seed))


@dataclass(frozen=True)
class AchievedPrecision:
    """Precision of a simulated survey, compared with the prediction of its plan."""

    points: int  # number of planned points that were measured
    planned: int  # number of planned points
    ratio: float  # median ratio of a posteriori to predicted sigmas of points
    # sum of squares of true errors over that of predicted sigmas, in the datum of the prediction; 1 in the
    # mean of many seeds, which its root is not
    error_ratio_squared: float
    sigma_px: float  # a posteriori, of an image coordinate
    predicted_px: float
    # mean square of true errors of mounts over their a posteriori sigmas; None without mounts
    mount_ratio_squared: float | None = None


def read_plan(folder: Path) -> PlannedSurvey:
    """Read a plan from a folder written by `kolinear plan network`.

    Raises:
        SurveyFileError: something is missing or wrong; the message has file and line.
    """
    refuse_links_out(folder)
    plan = read_json(folder / "plan.json", _Plan, "a plan")
    where = folder / "plan.json"
    cameras = tuple(_camera(where, camera) for camera in plan.cameras)
    rig = _rig(where, plan.mounts, cameras)
    angles, path = ("omega_deg", "phi_deg", "kappa_deg"), folder / "exterior.csv"
    texts = ("image",) if rig is None else ("image", "camera", "moment")
    table = read_table(path, texts, ("X", "Y", "Z", *angles))
    rotation = np.array([rotation_from_angles(*np.radians(row)) for row in table.values[:, 3:]])
    stations = Stations(table.keys("image"), table.values[:, :3].copy(), rotation)
    if rig is not None:
        taken_by = table.places("camera", [camera.name for camera in cameras], "plan.json")
        moments = tuple(dict.fromkeys(table.texts[2]))
        taken_at = table.places("moment", moments, "exterior.csv")
        stations = replace(stations, rig=rig, taken_by=taken_by, taken_at=taken_at)
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
    known = {*points, *stations.names}
    tables = tuple(_table(where, kind, lines) for kind, lines in plan.survey_observations.items())
    for observations in tables:
        for name in (name for column in observations.named for name in column if name not in known):
            raise SurveyFileError(f"{where}: {observations.kind}: '{name}' is not in the plan")
    return PlannedSurvey(
        plan.name,
        plan.unit,
        cameras,
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
        plan.scale_bars,
        tables,
        _given_mounts(plan.mounts),
    )


def _camera(where: Path, c: _Camera) -> Camera:
    if c.model not in MODELS or set(c.parameters) != set(MODELS[c.model].names):
        raise SurveyFileError(f"{where}: the parameters of camera {c.name} are not those of a known model")
    names = MODELS[c.model].names
    if not all(side > 0 for side in c.size_px) or c.size_px[0] * c.size_px[1] > MAX_PIXELS:
        raise SurveyFileError(f"{where}: photographs of {c.size_px[0]} x {c.size_px[1]} px")
    return Camera(
        c.name,
        c.model,
        c.size_px,
        np.array(c.pixel_mm),
        np.array([c.parameters[name] for name in names]),
        np.array([name in c.free for name in names]),
    )


def _rig(where: Path, mounts: Sequence[_Mount], cameras: tuple[Camera, ...]) -> Mounts | None:
    """Return the rig of a plan; None for a single camera."""
    if [mount.camera for mount in mounts] != [camera.name for camera in cameras][: len(mounts)] or (
        len(cameras) > 1 and len(mounts) != len(cameras)
    ):
        raise SurveyFileError(f"{where}: mounts: needed one for each camera, in the order of the cameras")
    if not mounts:
        return None
    value = np.array([mount.value for mount in mounts])
    return Mounts(
        value[:, :3],
        np.array([rotation_from_angles(*np.radians(row)) for row in value[:, 3:]]),
        np.array([[mount.sigma is None or any(mount.sigma)] * 6 for mount in mounts]),
        tuple(mount.rig for mount in mounts),
    )


def _given_mounts(mounts: Sequence[_Mount]) -> MountObservations:
    """Return the given mounts, except for the reference camera."""
    on = [
        a for a, mount in enumerate(mounts) if mount.sigma is not None and any((*mount.value, *mount.sigma))
    ]
    value = np.array([mounts[a].value for a in on]).reshape(-1, 6) / IN_FILES
    sigma = np.array([mounts[a].sigma for a in on]).reshape(-1, 6) / IN_FILES
    covariance = np.eye(6) * sigma[:, None, :] ** 2
    return MountObservations(np.array(on, dtype=np.int64), value[:, :3], value[:, 3:], covariance)


def _table(where: Path, kind: str, rows: list[list[str | float]]) -> ObservationTable:
    """Return the survey observations of one kind in a plan."""
    texts, columns = TABLES[kind].texts, TABLES[kind].columns()
    n = len(texts)
    for row in rows:
        if len(row) != n + len(columns) or [isinstance(cell, str) for cell in row] != [
            k < n for k in range(len(row))
        ]:
            raise SurveyFileError(f"{where}: {kind}: row {row!r:.60}, needed {listed([*texts, *columns])}")
    names = {name: [str(row[k]) for row in rows] for k, name in enumerate(texts)}
    values = {name: np.array([row[n + k] for row in rows], dtype=float) for k, name in enumerate(columns)}
    return observation_table(kind, array_table(f"{where}: {kind}", names, values))


def codes_of(plan: PlannedSurvey, family: CodeFamily) -> IntArray:
    """Return the code number of each target, UNCODED for targets without a ring, (n,).

    Args:
        plan: the plan.
        family: code family of the targets.

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


def write_simulation(
    plan: PlannedSurvey, folder: Path, *, codes: str | None = "ring14", seed: int = 0
) -> Path:
    """Write the photographs or image points of a plan, and their survey file; return the path of this file.

    Observations of every kind, including mounts of the rig and image points, have errors with the standard
    deviations of the plan.

    Args:
        plan: the plan.
        folder: existing folder; photographs are written into its subfolder `photographs`.
        codes: family of the coded targets; None for image points in place of photographs.
        seed: seed of the noise.

    Raises:
        KolinearError: too many codes, targets that overlap, or a file that cannot be written.
    """
    network, truth = plan.simulated(seed)
    if codes is None:
        targets = ["[observations]", 'file = "image_points.csv"']
        seen = network.image_points
        rows = (
            (network.images[i], network.points[j], *xy, *np.sqrt(np.diagonal(C)).tolist())
            for i, j, xy, C in zip(seen.image, seen.point, seen.xy.tolist(), seen.covariance, strict=True)
        )
        _write(folder / "image_points.csv", IMAGE_POINTS, rows)
    else:
        targets = ["[targets]", 'polarity = "dark"', f'codes = "{codes}"']
        _write_photographs(plan, folder, truth.points, codes, seed)
        names = tuple(name or "-" for name in names_of(plan, codes))
        images = tuple(f"photographs/{name}.png" for name in network.images)
        network = replace(network, points=names, images=images)
    lines = ["[survey]", 'name = "simulation"', f'unit = "{plan.unit}"']
    for a, camera in enumerate(plan.cameras):
        images_of = [name for name, of in zip(network.images, network.camera, strict=True) if of == a]
        free = [parameter for parameter, is_free in zip(camera.names, camera.free, strict=True) if is_free]
        values = zip(camera.names, camera.parameters.tolist(), strict=True)
        held = [
            f"{parameter} = {value!r}"
            for parameter, value in values
            if parameter not in free and parameter != "c"
        ]
        globs = [escape(name) for name in images_of]
        section = ["[[camera]]", f"name = {json.dumps(camera.name)}", f"images = {json.dumps(globs)}"]
        section += [f"size_px = {list(camera.size_px)}", f"pixel_mm = {camera.pixel_mm.tolist()}"]
        section += [f"c_mm = {camera.c_px * float(np.mean(camera.pixel_mm))!r}", f'model = "{camera.model}"']
        section += [f"free = {json.dumps(free)}"]
        lines += [*section, f"fixed = {{ {', '.join(held)} }}"] if held else section
    lines += [*_rig_section(folder, network, truth), *targets]
    bars = network.scale_bars
    for start, end, length, sigma in zip(bars.start, bars.end, bars.length, bars.sigma, strict=True):
        ends = [json.dumps(network.points[j]) for j in (start, end)]
        lines += ["[[scale_bar]]", f"from = {ends[0]}", f"to = {ends[1]}"]
        lines += [f"length = {float(length)!r}", f"sigma = {float(sigma)!r}"]
    for kind, of in TABLES.items():
        of_kind = [
            row
            for observations in network.further
            if type(observations) is of
            for row in observations.table_rows(network)
        ]
        if of_kind:
            file = f"{kind.replace(' ', '_')}.csv"
            _write(folder / file, (*of.texts, *of.columns()), of_kind)
            lines += ["[[survey_observations]]", f'kind = "{kind}"', f'file = "{file}"']
    lines += ["[datum]", 'kind = "free"', "[compare]", 'backend = "none"']
    path = folder / "survey.toml"
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
    return path


def _write(path: Path, header: Sequence[str], rows: Iterable[Sequence[object]]) -> None:
    path.write_text(csv_text(header, rows), encoding="utf-8", newline="")


def _write_photographs(plan: PlannedSurvey, folder: Path, xyz: FloatArray, codes: str, seed: int) -> None:
    """Render the photographs of a plan with its points at their true positions."""
    family = _rings(codes)
    unknown = np.isnan(plan.normals).any(axis=1)
    if unknown.any():
        first = plan.points[int(np.argmax(unknown))]
        raise SurveyFileError(f"plan: point '{first}' has no normal; photographs of it need nX, nY, nZ")
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
    stations = plan.stations
    targets = PlannedTargets(xyz, plan.normals, codes_of(plan, family), plan.diameter / 2, family)
    for a, rows in enumerate(rows_of(stations.camera, len(plan.cameras))):
        write_planned_photographs(
            [pictures / f"{stations.names[i]}.png" for i in rows],
            plan.cameras[a],
            stations.position[rows],
            stations.rotation[rows],
            targets=targets,
            seen=plan.seen[rows],
            optics=optics,
            seed=seed + a,
        )


def _rig_section(folder: Path, network: Network, truth: Estimate) -> list[str]:
    """Return the lines of the rig, and write its moments and given mounts."""
    if truth.mounts is None or network.moment is None:
        return []
    ((rig, on),) = truth.mounts.by_rig().items()
    cameras = [truth.cameras[a].name for a in on]
    _write(folder / MOMENTS, ("image", "moment"), zip(network.images, network.moment.tolist(), strict=True))
    lines = ["[[rig]]", f"name = {json.dumps(rig)}", f"cameras = {json.dumps(cameras)}"]
    lines += [f'moment = "{MOMENTS}"']
    (given,) = (kind for kind in network.further if isinstance(kind, MountObservations))
    if len(given):
        sigma = np.sqrt(np.diagonal(given.covariance, axis1=1, axis2=2))
        values = np.hstack([IN_FILES * given.values, IN_FILES * sigma]).tolist()
        rows = [(truth.cameras[a].name, *row) for a, row in zip(given.camera, values, strict=True)]
        _write(folder / MOUNTS, ("camera", *VALUES, *SIGMAS), rows)
        lines += [f'mounts = "{MOUNTS}"']
    return lines


def _rings(codes: str) -> CodeFamily:
    family = code_family(codes)
    if not isinstance(family, CodeFamily):
        raise SurveyFileError(f"--family {codes}: needed rings, such as ring14")
    return family


def names_of(plan: PlannedSurvey, codes: str | None) -> tuple[str | None, ...]:
    """Return the names of a plan's points in the survey, None for points without a code, (n,).

    Args:
        plan: the plan.
        codes: family of the coded targets; None if image points were simulated.
    """
    if codes is None:
        return plan.points
    return tuple(None if code == UNCODED else str(code) for code in codes_of(plan, _rings(codes)).tolist())


def compare_with_plan(
    plan: PlannedSurvey, codes: str | None, result: SurveyResult, *, seed: int = 0
) -> AchievedPrecision:
    """Compare the precision of a simulated survey with its plan.

    True errors are in the datum of the prediction: the result is moved onto the truth by the motions that no
    observation determines. If a bar gives the scale, an error of the scale counts as an error of the points.

    Args:
        plan: the plan.
        codes: as in `write_simulation`.
        result: result of the survey.
        seed: as in `write_simulation`.

    Raises:
        SurveyFileError: fewer than 3 coded targets were measured, so the other points cannot be identified.
    """
    names = {name: j for j, name in enumerate(result.network.points)}
    xyz = result.estimate.points
    true = plan.simulated(seed)[1].points
    pairs = [(names[name], k) for k, name in enumerate(names_of(plan, codes)) if name in names]
    pairs = [(j, k) for j, k in pairs if np.isfinite(xyz[j]).all()]
    if len(pairs) < 3:
        raise SurveyFileError(f"simulation: {counted(len(pairs), 'coded target')} in the result, needed 3")
    j, k = (np.array(column) for column in zip(*pairs, strict=True))
    placed = fit_similarity(xyz[j], true[k]).apply(xyz)
    away = np.linalg.norm(true[:, None] - placed[None], axis=2)
    apart = np.linalg.norm(true[:, None] - true[None], axis=2)
    np.fill_diagonal(apart, np.inf)
    nearest = np.where(np.isfinite(away), away, np.inf).argmin(axis=1)
    identified = (
        away[np.arange(len(away)), nearest] < MAX_NEIGHBOUR_FRACTION * apart.min(axis=1)
    ) & np.isfinite(plan.sigma[:, 0])
    j, k = nearest[identified], np.flatnonzero(identified)
    a, Q = result.adjustment, result.solution.point_covariance
    motion = fit_motions(xyz[j], true[k], open_motions(a, j))
    error = motion.apply(xyz[j]) - true[k]
    predicted = np.sqrt((plan.sigma[k] ** 2).mean(axis=1))
    if Q is None:
        raise SurveyFileError("simulation: the result has no standard deviations")
    sigma = motion.scale * np.sqrt(np.trace(Q[j], axis1=1, axis2=2) / 3)
    return AchievedPrecision(
        int(identified.sum()),
        len(plan.points),
        float(np.median(sigma / predicted)),
        float((error**2).mean() / (predicted**2).mean()),
        a.sigma0_px,
        plan.sigma_px,
        _mount_error(plan, result.solution, motion.scale),
    )


def _mount_error(plan: PlannedSurvey, result: Solution, scale: float) -> float | None:
    """Return the mean square of the true errors of the adjusted mounts over their standard deviations."""
    rig, adjusted, Q = plan.stations.rig, result.estimate.mounts, result.mount_covariance
    if rig is None or adjusted is None or Q is None or not adjusted.free.any():
        return None
    unit = np.repeat([scale, 1.0], 3)
    values = [
        np.hstack([mounts.position, angles_from_rotation(mounts.rotation)]) for mounts in (adjusted, rig)
    ]
    error = unit * values[0] - values[1]
    error[:, 3:] = (error[:, 3:] + np.pi) % (2 * np.pi) - np.pi
    w = error[adjusted.free] / (unit * np.sqrt(np.diagonal(Q, axis1=1, axis2=2)))[adjusted.free]
    return float((w**2).mean())
