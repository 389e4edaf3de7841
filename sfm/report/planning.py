"""A planned network as page, tables and JSON: what it will give, where it is weak, the photographs."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

from sfm.adjustment.quality.statistics import POWER, reliability
from sfm.conventions import FloatArray, angles_from_rotation
from sfm.display import counted
from sfm.files.plain_text import csv_text, or_none
from sfm.network import Estimate, ImagePoints, Network
from sfm.planning.findings import verdict_of_plan
from sfm.planning.plan import Plan
from sfm.planning.sight import MIN_PIXELS
from sfm.planning.wanted import ALPHA, found_displacement
from sfm.report.html.page import render
from sfm.report.numbers import finer_unit, or_unlimited, raised, significant
from sfm.report.page_files import write_files
from sfm.report.phrases import NORMAL_95
from sfm.report.viewer.embedded import viewer_of
from sfm.report.viewer.pictures import Pictures
from sfm.report.viewer.scene import ViewerScene
from sfm.report.viewer.stored_scene import scene_of_stored
from sfm.solution import Solution

FILES = ("points.csv", "image_points.csv", "exterior.csv", "shots.csv", "plan.json", "plan.html")
POINTS = ("id", "X", "Y", "Z", "nX", "nY", "nZ", "sX", "sY", "sZ", "rays", "angle_deg", "coded")
SHOTS = (
    *(
        "image",
        "X",
        "Y",
        "Z",
        "azimuth_deg",
        "elevation_deg",
        "roll_deg",
        "distance",
        "focus",
        "points",
        "coded",
    ),
)
NAMED = 12  # weak points that are listed


def write_plan(plan: Plan, out: Path) -> Path:
    """Write a plan into a folder and return the path of its page.

    Args:
        plan: the plan.
        out: the folder.

    Raises:
        OutputError: the folder holds something else or cannot be written.
    """
    p = plan.prediction
    m, n = np.nonzero(p.sight.seen)
    deviation = np.sqrt(np.diagonal(p.sight.covariance[m, n], axis1=1, axis2=2))
    angles = np.degrees(angles_from_rotation(p.stations.rotation))
    texts = (
        csv_text(POINTS, _points(plan)),
        csv_text(
            ("image", "point", "x_px", "y_px", "sx_px", "sy_px"),
            (
                (p.stations.names[i], p.planned.names[j], *p.sight.xy[i, j].tolist(), *s)
                for i, j, s in zip(m, n, deviation.tolist(), strict=True)
            ),
        ),
        csv_text(
            ("image", "X", "Y", "Z", "omega_deg", "phi_deg", "kappa_deg"),
            (
                (name, *X0, *a)
                for name, X0, a in zip(
                    p.stations.names, p.stations.position.tolist(), angles.tolist(), strict=True
                )
            ),
        ),
        csv_text(
            SHOTS,
            (
                (
                    *(s.station, *np.round(s.position, 6).tolist(), round(s.azimuth_deg, 2)),
                    *(
                        round(s.elevation_deg, 2),
                        round(s.roll_deg, 2),
                        round(s.distance, 6),
                        round(s.focus, 6),
                    ),
                    *(s.points, s.coded),
                )
                for s in plan.shots
            ),
        ),
        json.dumps(plan_summary(plan), indent=2, ensure_ascii=False, allow_nan=False) + "\n",
        plan_page(plan),
    )
    return write_files(out, tuple(zip(FILES, texts, strict=True)), main=FILES[-1])


def figures(plan: Plan) -> list[tuple[str, str]]:
    """Return the figures of a plan, each with its unit."""
    p, a = plan.prediction, plan.prediction.adjustment
    found = reliability(a)
    d = found_displacement(p)[p.determined]
    r = a.redundancy_numbers[np.isfinite(a.redundancy_numbers)]
    worst, along = float(p.sigma[p.determined].max()), float(p.largest_sigma[p.determined].max())
    per_mm = p.scale_number / float(np.mean(p.camera.pixel_mm))
    rows = [
        ("photographs", f"{len(p.stations)} from {counted(p.stations.places, 'station')}"),
        ("object points", f"{int(p.determined.sum())} of {len(p.planned.names)} determined"),
        ("image points", f"{len(a.network.image_points)}, sigma {significant(p.sigma_px)} px (median)"),
        ("rays of a point", f"{p.rays.min()} to {p.rays.max()}, median {np.median(p.rays):.0f}"),
        (
            "sigma of points" + (", what is not determined left out" if a.undetermined else ""),
            f"1 sigma {_length(plan, p.rms_sigma)} RMS per coordinate (95 % "
            f"{_length(plan, NORMAL_95 * p.rms_sigma)}), {_length(plan, worst)} at the worst point, "
            f"{_length(plan, along)} in its worst direction",
        ),
        (
            f"displacement found between two such surveys ({POWER:.0%} power, {ALPHA:.1%} significance)",
            f"{_length(plan, float(np.median(d)))} (median), {_length(plan, float(d.max()))} (worst)",
        ),
        (
            "redundancy",
            f"{a.redundancy}; redundancy numbers {abs(r.min()):.2f} to {r.max():.2f}, mean {r.mean():.2f}",
        ),
        ("gross error that is found", _spread(found.minimal_bias, "px")),
        ("its effect if it is not found", _spread(found.external, "sigmas of an unknown")),
        (
            "rule of Fraser",
            f"sigma = q S sigma_image / sqrt(k): q {p.q:.2f}, S {per_mm:.4g} {plan.unit} per mm, "
            f"k {p.photographs_per_station:.2g} (photographs over stations)",
        ),
        (
            "target diameter",
            f"{plan.target.diameter:.4g} {plan.unit} for {MIN_PIXELS:g} px from the farthest station at the "
            "steepest ray",
        ),
        ("coded targets", f"{len(plan.coded)} give every photograph five, or all that it shows"),
    ]
    if a.undetermined:
        rows.append(("not determined", _first(a.undetermined)))
    return rows


def plan_page(plan: Plan) -> str:
    """Return the page: the scene to explore, figures, list of photographs, weak points and the camera."""
    scene, verdict = plan_scene(plan), verdict_of_plan(plan)
    factor, fine = finer_unit(plan.unit, plan.prediction.rms_sigma)
    return render(
        "plan.html",
        viewer=viewer_of(scene, Pictures()),
        plan=plan,
        p=plan.prediction,
        title=plan.name,
        headline=verdict.headline,
        level=verdict.level,
        remarks=verdict.lines,
        figures=figures(plan),
        fine=fine,
        factor=factor,
        camera_rows=_camera_rows(plan),
        size=float(np.abs([*plan.prediction.planned.xyz, *(s.position for s in plan.shots)]).max()),
        named=NAMED,
    )


def plan_scene(plan: Plan) -> ViewerScene:
    """Return the scene of a plan: stations, rays and all points, those not determined included."""
    p = plan.prediction
    a = p.adjustment
    m, n = np.nonzero(p.sight.seen)
    network = Network(
        p.stations.names,
        np.zeros(len(p.stations), dtype=np.int64),
        p.planned.names,
        ImagePoints(m, n, p.sight.xy[m, n], p.sight.covariance[m, n]),
    )
    estimate = Estimate((p.camera,), p.stations.position, p.stations.rotation, p.planned.xyz)
    covariance = np.where(np.isfinite(p.covariance), p.covariance, np.nan)
    of_position = np.full((len(p.stations), 3, 3), np.nan)
    used = p.photograph >= 0
    of_position[used] = a.covariance.exterior[p.photograph[used], :3, :3]
    return scene_of_stored(Solution(plan.name, network, estimate, covariance, of_position, unit=plan.unit))


def plan_summary(plan: Plan) -> dict[str, Any]:
    """Return what plan.json holds: plain values only, None for what is not known."""
    p, c, camera = plan.prediction, plan.calibration, plan.prediction.camera
    verdict = verdict_of_plan(plan)
    return {
        "name": plan.name,
        "unit": plan.unit,
        **verdict.as_dict(),
        "reached": plan.reached,
        "shortfall": or_none(plan.shortfall),
        "wanted": {
            "sigma": plan.wanted.sigma,
            "length_sigma": plan.wanted.length_sigma,
            "displacement": plan.wanted.displacement,
        },
        "photographs": len(p.stations),
        "stations": p.stations.places,
        "points": len(p.planned.names),
        "determined": int(p.determined.sum()),
        "sigma_rms": or_none(p.rms_sigma),
        "sigma_largest": or_none(float(p.sigma.max())),
        "sigma_px": p.sigma_px,
        "redundancy": p.adjustment.redundancy,
        "fraser": {"q": p.q, "k": p.photographs_per_station, "S_per_px": p.scale_number},
        "target": {
            "diameter": plan.seeing.diameter,
            "diameter_for_7_px": plan.target.diameter,
            "contrast": plan.seeing.target.contrast,
            "noise": plan.seeing.target.noise,
            "blur_px": plan.seeing.target.blur_px,
        },
        "coded_targets": len(plan.coded),
        "scale_bars": len(p.adjustment.network.scale_bars),
        "camera": {
            "name": camera.name,
            "model": camera.model,
            "size_px": list(camera.size_px),
            "pixel_mm": camera.pixel_mm.tolist(),
            "parameters": dict(zip(camera.names, camera.parameters.tolist(), strict=True)),
            "free": [n for n, f in zip(camera.names, camera.free, strict=True) if f],
            "can_be_calibrated": None if c is None else c.good,
            "sigma": {} if c is None else {n: or_none(s) for n, s in zip(c.parameters, c.sigma, strict=True)},
        },
        "weak_points": [{"point": w.name, "sigma": or_none(w.sigma), "reason": w.reason} for w in plan.weak],
    }


def _camera_rows(plan: Plan) -> list[tuple[str, ...]]:
    c, camera = plan.calibration, plan.prediction.camera
    if c is None:
        return []
    units = dict(zip(camera.names, camera.units, strict=True))
    rows: list[tuple[str, ...]] = []
    for name, sigma in zip(c.parameters, c.sigma.tolist(), strict=True):
        others = [
            f"{pair.second if pair.first.startswith(name + ' ') else pair.first} ({pair.value:+.2f})"
            for pair in c.correlations
            if name in (pair.first.split(" ")[0], pair.second.split(" ")[0])
        ]
        outer = [
            f"{one.partners} ({one.largest:+.2f})"
            for one in c.with_exterior
            if one.parameter.startswith(f"{name} ")
        ]
        shown = significant(sigma) if np.isfinite(sigma) else "not determined"
        rows.append((name, shown, raised(units[name]), "; ".join((*others, *outer))))
    return rows


def _points(plan: Plan) -> list[tuple[object, ...]]:
    p = plan.prediction
    sigma = np.sqrt(np.diagonal(p.covariance, axis1=1, axis2=2))
    coded = set(plan.coded.tolist())

    def cell(value: float) -> object:
        return value if np.isfinite(value) else ""

    return [
        (
            *(name, *p.planned.xyz[j].tolist(), *map(cell, p.planned.normals[j].tolist())),
            *map(cell, sigma[j].tolist()),
            *(int(p.rays[j]), cell(float(p.angle_deg[j])), int(j in coded)),
        )
        for j, name in enumerate(p.planned.names)
    ]


def _first(undetermined: tuple[str, ...]) -> str:
    """Write the first of what is not determined, and how many more there are."""
    more = len(undetermined) - 1
    return undetermined[0] + (f"; and {more} more" if more else "")


def _spread(values: FloatArray, unit: str) -> str:
    """Write median and largest of reliabilities, which are unlimited where nothing checks an image point."""
    median, largest = (or_unlimited(float(value)) for value in (np.median(values), values.max()))
    return f"{median} {unit} (median), {largest} at most"


def _length(plan: Plan, value: float) -> str:
    factor, unit = finer_unit(plan.unit, value)
    return f"{significant(value * factor)} {unit}"
