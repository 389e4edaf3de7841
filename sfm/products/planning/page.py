"""The page of a planned network: predicted precision, weak points, and the photographs to take."""

from __future__ import annotations

import io
from collections.abc import Sequence
from itertools import compress
from typing import Any

import numpy as np
from matplotlib.backends.backend_svg import FigureCanvasSVG
from matplotlib.figure import Figure

from sfm.adjustment.quality.statistics import reliability
from sfm.files.result_tables import IN_FILES
from sfm.model.camera import Camera
from sfm.model.conventions import FloatArray, angles_from_rotation
from sfm.model.display import counted
from sfm.model.distributions import LEVEL, POWER
from sfm.model.estimate import Estimate
from sfm.model.network import ImagePoints, Network
from sfm.model.observations.control_and_bars import ScaleBars
from sfm.model.observations.pose import MountObservations
from sfm.model.observations.tables import TABLES
from sfm.model.solution import Solution
from sfm.products.planning import MIN_PIXELS
from sfm.products.planning.plan import Plan, verdict_of_plan
from sfm.products.planning.prediction import found_displacement
from sfm.products.planning.stations import Shot, Stations
from sfm.products.planning.visibility import compute_target_size
from sfm.products.planning.weakness import Calibratability, Contribution
from sfm.report.page import (
    YES,
    Column,
    FoldedParts,
    Note,
    Page,
    Paragraph,
    Part,
    Section,
    Table,
    axes,
    facts,
    file_columns,
    plain,
    values_of,
)
from sfm.report.phrases import (
    NORMAL_95,
    NOT_DETERMINED,
    describe_rigs,
    finer_unit,
    fixed,
    length_of,
    or_unlimited,
    placed,
    raised,
    significant,
    with_exponent,
)
from sfm.report.rig_mounts import rigs_of
from sfm.report.tables.summary import summary_of_rigs
from sfm.report.viewer.embedded import Viewer, scene_of_stored, viewer_of
from sfm.report.viewer.pictures import Pictures

MAX_NAMED = 12  # weak points listed
SIZE_IN = (7.0, 4.5)  # of the design diagram
DIAGRAM_PIXELS = (MIN_PIXELS, 10.0, 15.0, 20.0)  # px across the target, one line of the diagram each
EXTERIOR = ("X", "Y", "Z", "omega_deg", "phi_deg", "kappa_deg")
IMAGE_POINTS = ("image", "point", "x_px", "y_px", "sx_px", "sy_px")


def page(plan: Plan) -> Page:
    """Return the page of a plan: scene, key figures, photographs, weak points and camera."""
    p, unit = plan.prediction, plan.unit
    m, n = np.nonzero(p.sight.seen)
    deviation = np.sqrt(np.diagonal(p.sight.covariance[m, n], axis1=1, axis2=2))
    seen = [
        (p.stations.names[i], p.planned.names[j], *xy, *s)
        for i, j, xy, s in zip(m, n, p.sight.xy[m, n].tolist(), deviation.tolist(), strict=True)
    ]
    size = float(np.abs([*p.planned.xyz, *(shot.position for shot in plan.shots)]).max())
    columns = shot_columns(unit, size)
    points = _points(plan, size)
    prediction = Note(
        "Predicted for the standard deviations of image points that the plan states, with a free datum and "
        "the camera adjusted as described below. Targets are assumed to be measured in every photograph "
        "that sees them. Sigma of a point: RMS of its three coordinates."
    )
    axis = Note(
        "Azimuth (from +X towards +Y) and elevation give the viewing direction. Roll: counter-clockwise "
        "about that direction, 0 upright. Distance: mean distance of the visible points along the axis. "
        "Focus: one setting for all photographs, as a calibration is valid for one focus only. Unless it "
        "was given, the nearest and the farthest point are equally sharp."
    )
    rows = [(name[0].upper() + name[1:], value) for name, value in figures(plan)]
    calibrations = [part for c in plan.calibrations for part in _calibration(c, p.cameras)]
    return Page(
        "plan",
        "Plan of a network",
        plan.name,
        verdict_of_plan(plan),
        (
            Section("Figures", facts(rows), prediction),
            Section("Photographs", Table(columns, shot_rows(plan.shots)), axis),
            Section("Weak points", *_weak(plan)),
            Section("Camera", *(calibrations or [Paragraph("The interior orientation is held fixed.")])),
            Section("Rig", *_rigs(plan)),
            Section("Gain", *_gain(plan)),
            Section("Points", FoldedParts(counted(len(points.rows), "point"), points)),
        ),
        viewer=plan_viewer(plan),
        summary=_summary(plan),
        files=(
            Table(tuple(Column(name=name) for name in IMAGE_POINTS), seen, "image_points"),
            exterior_table(p.stations, p.cameras),
            Table(columns, shot_rows(plan.shots, rounded=True), "shots"),
        ),
    )


def exterior_table(stations: Stations, cameras: Sequence[Camera] = ()) -> Table:
    """Return the exterior orientation of planned photographs for a file; for a rig with camera and moment."""
    angles = np.degrees(angles_from_rotation(stations.rotation)).tolist()
    rows: list[tuple[object, ...]] = [
        (n, *X0, *a) for n, X0, a in zip(stations.names, stations.position.tolist(), angles, strict=True)
    ]
    names: tuple[str, ...] = ("image", *EXTERIOR)
    if stations.taken_at is not None:
        names = (*names, "camera", "moment")
        taken = zip(stations.camera, stations.taken_at.tolist(), strict=True)
        rows = [(*row, cameras[a].name, at + 1) for row, (a, at) in zip(rows, taken, strict=True)]
    return Table(tuple(Column(name=name) for name in names), rows, "exterior")


def shot_columns(unit: str, size: float, *, planned: bool = True) -> tuple[Column, ...]:
    """Return the columns of photographs to be taken.

    Args:
        unit: object unit.
        size: largest coordinate in the table, in that unit.
        planned: whether focus and coded points are planned as well.
    """
    return (
        Column("station", "image"),
        *axes("", unit, lambda value: placed(value, size)),
        Column("azimuth", "azimuth_deg", "deg", "z.0f"),
        Column("elevation", "elevation_deg", "deg", "z.0f"),
        Column("roll", "roll_deg", "deg", "z.0f"),
        Column("distance", "distance", unit, ".4g"),
        Column("focus" if planned else None, "focus", unit, ".4g"),
        Column("points", "points", format=str),
        Column("coded" if planned else None, "coded", format=str),
    )


def shot_rows(shots: Sequence[Shot], *, rounded: bool = False) -> list[tuple[object, ...]]:
    """Return the rows of photographs to be taken, rounded for files to what can be set up."""
    rows: list[tuple[object, ...]] = []
    for shot in shots:
        lengths = [*shot.position.tolist(), shot.distance, shot.focus]
        angles = [shot.azimuth_deg, shot.elevation_deg, shot.roll_deg]
        if rounded:
            lengths, angles = ([round(value, to) for value in x] for x, to in ((lengths, 6), (angles, 2)))
        rows.append((shot.station, *lengths[:3], *angles, *lengths[3:], shot.points, shot.coded))
    return rows


def _points(plan: Plan, size: float) -> Table:
    """Return the points with their predicted precision."""
    p = plan.prediction
    factor, fine = finer_unit(plan.unit, p.rms_sigma)
    columns = (
        Column("point", "id"),
        *axes("", plan.unit, lambda value: placed(value, size)),
        *file_columns("nX", "nY", "nZ", "sX", "sY", "sZ"),
        Column("sigma", "", fine, significant, factor),
        Column("rays", "rays", format=str),
        Column("angle", "angle_deg", "deg", "z.0f", unknown=""),
        Column(None, "coded", flag=YES),
    )
    sigma = np.sqrt(np.diagonal(p.covariance, axis1=1, axis2=2))
    coded = np.isin(np.arange(len(p.planned.names)), plan.coded)
    rows = [
        (name, *xyz, *normal, *s, rms if known else NOT_DETERMINED, *others)
        for name, xyz, normal, s, rms, known, *others in zip(
            p.planned.names,
            p.planned.xyz,
            p.planned.normals,
            sigma,
            p.sigma,
            p.determined,
            p.rays,
            p.angle_deg,
            coded,
            strict=True,
        )
    ]
    return Table(columns, rows, "points")


def _weak(plan: Plan) -> tuple[Part, ...]:
    """Return the weak points, worst first."""
    if not plan.weak:
        return (Paragraph("None: no point is more than 1.5 times as uncertain as the median."),)
    factor, fine = finer_unit(plan.unit, plan.prediction.rms_sigma)
    columns = (Column("point"), Column("sigma", "", fine, significant, factor), Column("reason"))
    rows = [
        (point.name, point.sigma if np.isfinite(point.sigma) else NOT_DETERMINED, point.reason)
        for point in plan.weak[:MAX_NAMED]
    ]
    more = (Note(f"The worst {MAX_NAMED} of {len(plan.weak)}."),) if len(plan.weak) > MAX_NAMED else ()
    return Table(columns, rows), *more


def _calibration(c: Calibratability, cameras: Sequence[Camera]) -> tuple[Part, ...]:
    """Return the parts on whether the network calibrates one camera."""
    rolled, turned, deep = fixed(100 * c.rolled, 0), fixed(c.convergence_deg, 0), fixed(100 * c.depth, 0)
    words = Paragraph(
        f"The network {'calibrates' if c.good else 'does not calibrate'} "
        f"{'the camera' if len(cameras) == 1 else f'camera {c.camera}'}. The uncertainty that remains in it "
        f"contributes {significant(c.contribution)} sigmas of an image coordinate, and adjusting it costs "
        f"{significant(100 * c.cost - 100, 2)} % of the precision of the points. {rolled} % of the "
        f"photographs are rolled, the axes converge by {turned} deg, and the object's depth is {deep} % of "
        "its distance."
    )
    columns = (
        Column("parameter"),
        Column("sigma", format=str),
        Column("unit"),
        Column("strongly correlated with"),
    )
    (camera,) = (camera for camera in cameras if camera.name == c.camera)
    return words, Table(columns, _camera_rows(c, camera))


def _rigs(plan: Plan) -> tuple[Part, ...]:
    """Return the mounts of the cameras of the rig, with their predicted precision; nothing without a rig."""
    if plan.prediction.stations.rig is None:
        return ()
    heads = tuple(map(Column, ("camera", "", "value", "sigma", "unit")))
    rows = [
        (mount.camera, name, *with_exponent(value, sigma), plan.unit if is_length else "deg")
        for rig in rigs_of(plan.prediction.adjustment, planned=True)
        for mount in rig.mounts
        for name, value, sigma, is_length in mount.values
    ]
    note = "In the image axes of the reference camera: x right, y up, z towards the camera."
    return Table(heads, rows), Note(note)


def _gain(plan: Plan) -> tuple[Part, ...]:
    """Return the contribution of the rig and of each kind of observation; nothing if there is none."""
    if not plan.contributions:
        return ()
    factor, fine = finer_unit(plan.unit, plan.prediction.rms_sigma)
    columns = (
        Column("", "kind"),
        Column("number", "count", format=str),
        *file_columns("shifts", "rotations", "scale", "points"),
        Column("gives"),
        Column("sigma without it", "sigma_without", fine, significant, factor),
        Column("sigma with it", "sigma_with", fine, significant, factor),
        Column("gain", "gain", format=".2f"),
    )
    rows = []
    for o in plan.contributions:
        known = np.isfinite(o.gain)
        precision = (o.sigma_without, o.sigma_with, o.gain) if known else (NOT_DETERMINED, NOT_DETERMINED, "")
        given = ", ".join(_given(o))
        rows.append((o.name, o.count, o.shifts, o.rotations, int(o.scale), o.points, given, *precision))
    note = Note(
        "Gain: standard deviation of points without the observation over that with it, RMS of a "
        "coordinate, all else unchanged. Gives: shifts, rotations and scale of the network, and points, "
        "that nothing else gives; both standard deviations are then those with inner constraints for "
        "these. If two kinds give the same, the gain of each is that in addition to the other. Scale bars: "
        "including distances in tables."
    )
    return Table(columns, rows, "gain"), note


def figures(plan: Plan) -> list[tuple[str, str]]:
    """Return the key figures of a plan, each with its unit."""
    p, a, unit = plan.prediction, plan.prediction.adjustment, plan.unit
    detected = reliability(a)
    d = found_displacement(p)[p.determined]
    r = a.redundancy_numbers[np.isfinite(a.redundancy_numbers)]
    worst, along = float(p.sigma[p.determined].max()), float(p.largest_sigma[p.determined].max())
    per_mm = p.scale_number / float(np.mean(p.cameras[0].pixel_mm))
    rows = [
        ("photographs", f"{len(p.stations)} from {counted(p.stations.places, 'station')}"),
        ("object points", f"{int(p.determined.sum())} of {len(p.planned.names)} determined"),
        ("image points", f"{len(a.network.image_points)}, sigma {significant(p.sigma_px)} px (median)"),
        ("rays of a point", f"{p.rays.min()} to {p.rays.max()}, median {np.median(p.rays):.0f}"),
        (
            "sigma of points" + (", without those not determined" if a.undetermined else ""),
            f"1 sigma {length_of(p.rms_sigma, unit)} RMS per coordinate (95 % "
            f"{length_of(NORMAL_95 * p.rms_sigma, unit)}), {length_of(worst, unit)} at the worst point, "
            f"{length_of(along, unit)} in its worst direction",
        ),
        (
            f"displacement detectable between two such surveys ({POWER:.0%} power, {LEVEL:.1%} significance)",
            f"{length_of(float(np.median(d)), unit)} (median), {length_of(float(d.max()), unit)} (worst)",
        ),
        (
            "redundancy",
            f"{a.redundancy}; redundancy numbers {abs(r.min()):.2f} to {r.max():.2f}, mean {r.mean():.2f}",
        ),
        ("detectable gross error", _spread(detected.minimal_bias, "px")),
        ("its effect if not detected", _spread(detected.external, "sigmas of an unknown")),
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
        (
            "coded targets",
            f"{len(plan.coded)} give every photograph five, or all that it shows, and name what is observed",
        ),
    ]
    rows += describe_rigs(rigs_of(a, planned=True), plan.unit)
    for contribution in plan.contributions:
        name = contribution.name
        if name == ScaleBars.name:
            name = "scale bars and distances"  # both are bars
        precise = "nothing without it"
        if np.isfinite(contribution.gain):
            precise = f"points {contribution.gain:.2f} times as precise"
        if given := _given(contribution):
            beside = contribution.shifts or contribution.rotations or contribution.scale
            precise = f"alone gives {' and '.join(given)}; {'beside that ' if beside else ''}{precise}"
        rows.append((f"gain by {name}", precise))
    if a.undetermined:
        more = f"; and {len(a.undetermined) - 1} more" if len(a.undetermined) > 1 else ""
        rows.append(("not determined", f"{a.undetermined[0]}{more}"))
    return rows


def _given(contribution: Contribution) -> list[str]:
    """Return in words what only one kind of observation determines."""
    counts = ((contribution.shifts, "shift"), (contribution.rotations, "rotation"))
    words = [counted(count, what) for count, what in counts if count]
    words += ["the scale"] if contribution.scale else []
    return words + ([counted(contribution.points, "point")] if contribution.points else [])


def _summary(plan: Plan) -> dict[str, Any]:
    """Return the content of plan.json."""
    p = plan.prediction
    by_camera = {c.camera: c for c in plan.calibrations}
    cameras = []
    for camera in p.cameras:
        c = by_camera.get(camera.name)
        cameras.append(
            values_of(camera, "name model size_px pixel_mm")
            | {
                "parameters": dict(zip(camera.names, camera.parameters, strict=True)),
                "free": list(compress(camera.names, camera.free)),
                "can_be_calibrated": None if c is None else c.good,
                "sigma": {} if c is None else dict(zip(c.parameters, c.sigma, strict=True)),
            }
        )
    return {
        **values_of(plan, "name unit"),
        **verdict_of_plan(plan).as_dict(),
        **values_of(plan, "reached shortfall"),
        "wanted": values_of(plan.wanted, "sigma length_sigma displacement"),
        "photographs": len(p.stations),
        "stations": p.stations.places,
        "points": len(p.planned.names),
        "determined": int(p.determined.sum()),
        "sigma_rms": p.rms_sigma,
        "sigma_largest": float(p.sigma.max()),
        "sigma_px": p.sigma_px,
        "redundancy": p.adjustment.redundancy,
        "fraser": {"q": p.q, "k": p.photographs_per_station, "S_per_px": p.scale_number},
        "target": {
            "diameter": plan.seeing.diameter,
            "diameter_for_7_px": plan.target.diameter,
            **values_of(plan.seeing.target, "contrast noise blur_px"),
        },
        "coded_targets": len(plan.coded),
        **_observed(plan),
        "cameras": cameras,
        "rigs": summary_of_rigs(rigs_of(p.adjustment, planned=True)),
        "contributions": [
            values_of(contribution, "name count shifts rotations scale points sigma_without sigma_with gain")
            for contribution in plan.contributions
        ],
        "weak_points": [{"point": w.name, "sigma": w.sigma, "reason": w.reason} for w in plan.weak],
    }


def _observed(plan: Plan) -> dict[str, Any]:
    """Return the planned observations other than image points, with values, for a simulation."""
    network, mounts = plan.prediction.adjustment.network, plan.prediction.stations.rig
    bars = network.scale_bars
    ends = ([network.points[j] for j in side] for side in (bars.start, bars.end))
    tables = {
        kind: [
            row
            for observations in network.further
            if type(observations) is of
            for row in observations.table_rows(network)
        ]
        for kind, of in TABLES.items()
    }
    observed: dict[str, Any] = {
        "scale_bars": [list(bar) for bar in zip(*ends, bars.sigma.tolist(), strict=True)],
        "survey_observations": {kind: rows for kind, rows in tables.items() if rows},
        "mounts": [],
    }
    if mounts is None:
        return observed
    sigma = {int(a): np.zeros(6) for a in np.flatnonzero(~mounts.free.any(axis=1))}
    for observations in network.further:
        if isinstance(observations, MountObservations):
            deviations = np.sqrt(np.diagonal(observations.covariance, axis1=1, axis2=2))
            sigma |= dict(zip(observations.camera.tolist(), deviations, strict=True))
    values = np.hstack([mounts.position, angles_from_rotation(mounts.rotation)])
    for a, camera in enumerate(plan.prediction.cameras):
        mount = {
            "camera": camera.name,
            "rig": mounts.rig[a],
            "value": plain(IN_FILES * values[a]),
            "sigma": plain(IN_FILES * sigma[a]) if a in sigma else None,
        }
        observed["mounts"].append(mount)
    return observed


def _camera_rows(c: Calibratability, camera: Camera) -> list[tuple[str, ...]]:
    units = dict(zip(camera.names, camera.units, strict=True))
    rows: list[tuple[str, ...]] = []
    for name, sigma in zip(c.parameters, c.sigma.tolist(), strict=True):
        others = [
            f"{pair.second if pair.first.startswith(name + ' ') else pair.first} ({pair.value:+.2f})"
            for pair in c.correlations
            if name in (pair.first.split(" ")[0], pair.second.split(" ")[0])
        ]
        outer = [
            f"{correlation.partners} ({correlation.largest:+.2f})"
            for correlation in c.with_exterior
            if correlation.parameter.startswith(f"{name} ")
        ]
        shown = significant(sigma) if np.isfinite(sigma) else "not determined"
        rows.append((name, shown, raised(units[name]), "; ".join((*others, *outer))))
    return rows


def _spread(values: FloatArray, unit: str) -> str:
    """Write median and largest reliability, which is unlimited if nothing checks an image point."""
    median, largest = (or_unlimited(float(value)) for value in (np.median(values), values.max()))
    return f"{median} {unit} (median), {largest} at most"


def design_diagram(
    *,
    w_mm: float,
    d: float,
    c_mm: float,
    n: int,
    unit: str,
    tilt_deg: float = 0.0,
    lines: Sequence[float] = DIAGRAM_PIXELS,
) -> bytes:
    """Return the design diagram as SVG: dot diameter over distance, with a line for each minimum size.

    Args:
        w_mm: width of the sensor, mm.
        d: farthest distance of the camera from the object, where the diagram ends.
        c_mm: principal distance (focal length), mm.
        n: pixels along the width of the photograph.
        unit: unit of the distance and the diameter.
        tilt_deg: largest angle between the ray and the normal of a target, deg.
        lines: minimum size of the target in the photograph for each line, px.

    Raises:
        GeometryError: a number is not positive, or targets are not recognised at this tilt.

    Source: document 000, fig. 2.11, drawn there for 7 px and a camera of 18 mm.
    """
    figure = Figure(figsize=SIZE_IN, layout="constrained")
    FigureCanvasSVG(figure)
    axes = figure.add_subplot()
    for pixels in lines:
        end = compute_target_size(p=pixels, w_mm=w_mm, d=d, c_mm=c_mm, n=n, tilt_deg=tilt_deg).diameter
        axes.plot([0, d], [0, end], gid=f"{pixels:g} px")  # in proportion
        axes.annotate(f"{pixels:g} px", (d, end), xytext=(4, 0), textcoords="offset points", va="center")
    axes.set(
        xlim=(0, d),
        ylim=(0, None),
        xlabel=f"distance [{unit}]",
        ylabel=f"diameter of the dot [{unit}]",
        title=f"c = {c_mm:g} mm, sensor {w_mm:g} mm wide, {n} px, tilt up to {tilt_deg:g} deg",
    )
    axes.minorticks_on()
    axes.grid(which="both", alpha=0.3)
    buffer = io.BytesIO()
    figure.savefig(buffer, format="svg", metadata={"Date": None})
    return buffer.getvalue()


def plan_viewer(plan: Plan) -> Viewer:
    """Return the viewer of a plan: stations, rays and all points, including undetermined ones."""
    p = plan.prediction
    a = p.adjustment
    m, n = np.nonzero(p.sight.seen)
    network = Network(
        p.stations.names,
        p.stations.camera,
        p.planned.names,
        ImagePoints(m, n, p.sight.xy[m, n], p.sight.covariance[m, n]),
    )
    estimate = Estimate(p.cameras, p.stations.position, p.stations.rotation, p.planned.xyz)
    covariance = np.where(np.isfinite(p.covariance), p.covariance, np.nan)
    of_position = np.full((len(p.stations), 3, 3), np.nan)
    used = p.photograph >= 0
    of_position[used] = a.covariance.exterior[p.photograph[used], :3, :3]
    solution = Solution(plan.name, network, estimate, covariance, of_position, unit=plan.unit)
    return viewer_of(scene_of_stored(solution), Pictures())
