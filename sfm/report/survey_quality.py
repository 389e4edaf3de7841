"""Quality of a survey in its report: precision, geometry, given values, image points, cameras."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence

import numpy as np

from sfm.adjustment.quality.statistics import MIN_REPORTED_CORRELATION, Correlation
from sfm.files.result_tables import VARIANCE_COMPONENTS
from sfm.judgement.calibrated_cameras import InteriorParameter
from sfm.model.conventions import FloatArray
from sfm.model.display import counted, listed
from sfm.model.distributions import POWER
from sfm.report.findings import Findings
from sfm.report.given_residuals import given_parts
from sfm.report.network_geometry import WEAK_DEG, Geometry
from sfm.report.page import (
    Column,
    FoldedParts,
    Heading,
    Note,
    Paragraph,
    Part,
    Subheading,
    Table,
    axes,
    columns,
    columns_of,
    facts,
)
from sfm.report.phrases import (
    NORMAL_95,
    describe_fixed,
    describe_limiting,
    describe_neighbours,
    describe_test,
    describe_weights,
    finer_unit,
    finer_unit_of,
    fixed,
    general,
    or_unlimited,
    percent,
    probability,
    raised,
    significant,
    with_exponent,
)
from sfm.report.tables.csv_files import component_rows

MAX_BINS = 12  # numbers of rays listed one by one
MAX_OPEN = 30  # parameters shown without a click
MAX_WEAK_POINTS = 5
MAX_CORRELATIONS = 20  # correlations of the exterior orientation; all are in summary.json
OVER = f"{100 * MIN_REPORTED_CORRELATION:.0f} %"


def precision_parts(f: Findings) -> Iterator[Part]:
    """Yield the precision of points and photographs, and the weakest points."""
    p, result = f.precision, f.result
    a, unit = result.adjustment, result.length_unit
    factor, finer = finer_unit(unit, p.largest[3])
    of_centres, centre_unit = finer_unit_of(unit, p.centres)
    adjusted = not np.isnan(p.rms[3])
    yield Heading("Precision of the unknowns")
    if not adjusted:
        state = "held fixed" if p.fixed_points else "without standard deviations"
        yield Paragraph(f"The coordinates of all points are {state}.")
    rows = [
        ("object points, RMS, 1 sigma", p.rms, factor, finer),
        ("object points, RMS, 95 %", NORMAL_95 * p.rms, factor, finer),
        ("object points, largest sigma", p.largest, factor, finer),
        ("limiting: RMS if the cameras are free of error", p.limiting, factor, finer),
        ("projection centres, RMS sigma", p.centres, of_centres, centre_unit),
        ("omega, phi, kappa, RMS sigma", np.degrees(p.angles) * 3600, 1.0, "arc seconds"),
    ]
    shown = [
        (name, *(significant(value) for value in values * times), of)
        for name, values, times, of in rows
        if not np.isnan(values[3])
    ]
    yield Table(columns("standard deviation", ">X, omega", ">Y, phi", ">Z, kappa", ">all", "unit"), shown)
    if adjusted and p.fixed_points:
        yield Paragraph(f"RMS {describe_fixed(p)}.")
    if words := describe_limiting(p):
        yield Paragraph(words)
    yield Note(
        f"Standard deviations are a posteriori and in the datum of the adjustment ({a.datum}). In a free "
        "network they describe the positions of the points relative to one another, not in an outer frame."
    )
    if words := describe_neighbours(a):
        yield Paragraph(f"By the residuals, {words}.")
    size = f"{general(f.object_size, 5)} {unit}"
    yield Paragraph(f"The object is {size} across (diagonal of the box around its points).")
    if adjusted:
        weakest = np.argsort(-np.linalg.norm(np.nan_to_num(p.points), axis=1), kind="stable")[
            :MAX_WEAK_POINTS
        ]
        heads = (Column("weakest points"), *axes("s", finer, factor=factor), *columns(">rays"))
        yield Table(
            (*heads, Column("angle", "", "deg", "z.1f")),
            [
                (a.network.points[j], *p.points[j], f.geometry.rays[j], f.geometry.angle_deg[j])
                for j in weakest
            ],
        )
        yield Note(
            "kolinear plan more RESULT, with this folder as RESULT, proposes the additional photographs that "
            "help these points most."
        )


def geometry_parts(f: Findings) -> Iterator[Part]:
    """Yield rays, angles, residuals and coverage."""
    network, geometry = f.result.adjustment.network, f.geometry
    weak = listed(f"{network.points[j]} ({geometry.angle_deg[j]:.1f})" for j in geometry.weak)
    words = f"{counted(len(geometry.weak), 'point')}: {weak}" if len(geometry.weak) else "none"
    points = tuple(f"point {name}" for name in network.points)
    known = geometry.angle_deg[np.isfinite(geometry.angle_deg)]
    mean = f", mean {known.mean():.1f} deg; below {WEAK_DEG:g} deg: {words}" if len(known) else ""
    low, high = int(geometry.rays.min()), int(geometry.rays.max())
    yield Heading("Geometry of the network")
    covered = []
    for coverage in geometry.coverage:
        hull, radius = 100 * coverage.hull, 100 * coverage.radius
        area = f"{hull.min():.0f} to {hull.max():.0f} % of a photograph, mean {hull.mean():.0f} %"
        area += f", all together {100 * coverage.hull_of_all:.0f} %"
        reach = f"{radius.min():.0f} to {radius.max():.0f} % of half the diagonal"
        covered.append((f"coverage {coverage.camera}", f"{area}; reach from the centre {reach}"))
    yield facts(
        [
            (
                "rays of a point",
                f"{low} each" if low == high else f"{low} to {high}, mean {geometry.rays.mean():.1f}",
            ),
            ("points by rays", ", ".join(f"{rays}: {count}" for rays, count in points_by_rays(geometry))),
            ("intersection angle", _between(geometry.angle_deg, points, "deg", 1) + mean),
            ("RMS by point", f"{_between(geometry.point_rms_px, points, 'px', 4)} per coordinate"),
            (
                "RMS by photograph",
                f"{_between(geometry.image_rms_px, network.images, 'px', 4)} per coordinate",
            ),
            *covered,
        ]
    )
    yield Note(
        "Rays are the accepted image points of a point. Its intersection angle is the largest angle "
        "between two of them, 90 degrees at best. Coverage is the part of a photograph within the convex "
        "hull of its image points: the lens is known only there. points.csv and images.csv list every "
        "point and photograph."
    )


def points_by_rays(geometry: Geometry) -> tuple[tuple[str, int], ...]:
    """Return pairs of a number of rays and the number of points; ranges if there are many numbers."""
    histogram = geometry.histogram()
    if len(histogram) <= MAX_BINS:
        return tuple((str(rays), n) for rays, n in histogram)
    low, high = histogram[0][0], histogram[-1][0]
    width = -(-(high - low + 1) // MAX_BINS)
    bins = []
    for first in range(low, high + 1, width):
        last = min(first + width - 1, high)
        count = sum(n for rays, n in histogram if first <= rays <= last)
        bins.append((f"{first}-{last}" if last > first else str(first), count))
    return tuple(bins)


def _between(values: FloatArray, names: tuple[str, ...], unit: str, decimals: int) -> str:
    """Write the smallest and the largest value, each with its name."""
    if not np.isfinite(values).any():
        return "not known"
    ends = int(np.nanargmin(values)), int(np.nanargmax(values))
    return " to ".join(f"{values[k]:.{decimals}f} {unit} ({names[k]})" for k in ends)


def given_values_parts(f: Findings) -> tuple[Part, ...]:
    """Return the parts on how well the given values fit."""
    r = f.result
    return given_parts(f.given, r.adjustment, r.length_unit, r.control_check, r.equipment)


def image_point_parts(f: Findings) -> Iterator[Part]:
    """Yield sigma0, the global tests, and tests and reliability of the image coordinates."""
    a, s, sigma0 = f.result.adjustment, f.statistics, f.sigma0
    yield Heading("Image coordinates")
    rows = (
        ("sigma0, a posteriori, of all observations", fixed(sigma0.px, 5), "px"),
        ("sigma0 over the standard deviations of the weights", fixed(a.sigma0, 4), ""),
        ("the same at the start of the adjustment", significant(a.start_sigma0), ""),
        ("sigma0 on the sensor", fixed(sigma0.mm, 6), "mm"),
        ("standard deviation from the image points alone", fixed(sigma0.image_points_px, 5), "px"),
        ("standard deviation stated beforehand", fixed(sigma0.stated_px, 5), "px"),
        ("of the image points, a posteriori over stated", fixed(sigma0.ratio, 3), ""),
        ("RMS residual per coordinate", fixed(a.rms_px, 5), "px"),
        ("longest accepted residual vector", fixed(a.max_residual_px, 4), "px"),
    )
    yield Table(columns("", ">value", "unit"), rows)
    yield facts([("global test", describe_test(test, a)) for test in s.global_tests])
    if words := describe_weights(f.result):
        yield Paragraph(words)
    yield Note(
        "The global test asks whether the residuals confirm the standard deviations stated beforehand. That "
        "of the image points (sigma_px) is only a rough guess. A test that is not passed shows how much to "
        "correct it, unless sigma0 is several times too large."
    )
    if s.known:
        yield FoldedParts("Tests and reliability of single image coordinates", *_reliability(f), in_text=True)


def _reliability(f: Findings) -> Iterator[Part]:
    a, s = f.result.adjustment, f.statistics
    names = ("Baarda's w (sigma of the weights)", "Pope's tau (sigma0 as found)")
    tests = zip(names, (s.w, s.tau), (s.largest_w, s.largest_tau), strict=True)
    yield Table(
        (
            Column("test for a gross error"),
            *columns(">coordinates"),
            Column("critical value", format=".2f"),
            *columns(">beyond it"),
            Column("by chance", format=".1f"),
            Column("largest", format=".2f"),
        ),
        [
            (
                f"{name}, {percent(test.alpha)}",
                test.tested,
                test.critical,
                test.beyond,
                test.expected,
                largest,
            )
            for name, test, largest in tests
        ],
    )
    r, bias, effect = s.redundancy, s.minimal_bias, s.external
    rows = (
        ("redundancy number (0 no check, 1 full check)", fixed(r.median, 3), fixed(r.smallest, 3), ""),
        ("minimal bias", significant(bias.median), or_unlimited(bias.largest), "px"),
        ("external reliability", significant(effect.median), or_unlimited(effect.largest), "sigmas"),
    )
    yield Table(columns("reliability", ">median", ">worst", "unit"), rows)
    discount = f", {a.discount} less because of errors in common" if a.discount else ""
    yield Paragraph(
        f"The redundancy numbers add up to {fixed(s.redundancy_sum, 1)}, those of the image points alone to "
        f"{fixed(s.redundancy_of_image_points, 1)} (mean {fixed(r.mean, 3)}); the redundancy is "
        f"{a.redundancy}{discount}."
    )
    yield Paragraph(
        "Minimal bias: the smallest gross error for which the tau test of an image coordinate exceeds its "
        f"critical value, {fixed(s.reliability.critical, 2)}, in {fixed(100 * POWER, 0)} of 100 cases. "
        "External reliability: the effect of this error on an unknown if it is not detected, in standard "
        "deviations of the unknown."
    )
    yield Note(
        "Where the redundancy is small, another coordinate may exceed the critical value by more and be "
        "rejected instead. reliability.csv lists every image coordinate."
    )


def largest_residual_parts(f: Findings) -> Iterator[Part]:
    """Yield the largest standardised residuals."""
    if f.largest:
        yield Heading(f"The {len(f.largest)} largest accepted residuals")
        heads = (*columns("photograph", "point"), *axes("v", "px", "+.3f", parts="xy"))
        tests = (Column("w (Baarda)", format="+.2f"), Column("tau (Pope)", format="+.2f"))
        yield Table((*heads, *tests), f.largest)


PARAMETERS = columns("of", "parameter", ">value", ">sigma", "unit", ">value / sigma")


def _parameters(parameters: Sequence[InteriorParameter], *, of: bool = False) -> Table:
    tests = ("" if parameter.t is None else fixed(parameter.t, 1) for parameter in parameters)
    rows = [
        (
            parameter.owner,
            parameter.name,
            *with_exponent(parameter.value, parameter.sigma),
            raised(parameter.unit),
            t,
        )
        for parameter, t in zip(parameters, tests, strict=True)
    ]
    return Table(PARAMETERS[0 if of else 1 :], [row[0 if of else 1 :] for row in rows], all_in="cameras.csv")


def camera_parts(f: Findings) -> Iterator[Part]:
    """Yield the interior orientation of all cameras."""
    yield Heading("Cameras")
    for family in f.interior.families:
        camera = family.camera
        yield Subheading(family.name)
        size, pixel = camera.size_px, [general(1000 * side, 5) for side in camera.pixel_mm]
        shared = f"; these parameters are shared by {counted(family.photographs, 'photograph')}"
        yield Paragraph(
            f"model {camera.model}, {size[0]} x {size[1]} px of {pixel[0]} x {pixel[1]} µm"
            f"{shared if camera.shared else ''}"
        )
        yield _parameters(family.parameters)
    for lens in f.protocol.lenses:
        across, up, diagonal = (fixed(angle, 1) for angle in lens.field_of_view_deg)
        yield Paragraph(
            f"{lens.camera}: distortion up to {fixed(lens.largest_px, 1)} px; field of view {across} x {up} "
            f"deg, diagonal {diagonal} deg."
        )
    if f.protocol.cumulative:
        tests = (
            f"{test.parameters} of {test.camera}: {probability(test.probability)}"
            for test in f.protocol.cumulative
        )
        yield Paragraph(f"Radial distortion terms jointly tested against 0 (F test): {'; '.join(tests)}.")
    if single := f.interior.single:
        summary = f"{counted(len(single), 'parameter')} of single photographs and groups"
        yield FoldedParts(summary, _parameters(single, of=True), open=len(single) <= MAX_OPEN, in_text=True)
    for rig in f.rigs:
        yield Heading(f"Rig {rig.name}")
        yield Paragraph(
            f"In the image axes of camera {rig.reference}: x right, y up, z towards the camera. From "
            f"{rig.moments} moments with photographs of at least two cameras."
        )
        unit = f.result.length_unit
        rows = [
            (mount.camera, name, *with_exponent(value, sigma), unit if is_length else "deg")
            for mount in rig.mounts
            for name, value, sigma, is_length in mount.values
        ]
        yield Table(columns("camera", "", ">value", ">sigma", "unit"), rows)
        for mount in rig.mounts:
            if mount.epipolar is not None and len(mount.epipolar.px):
                points = counted(len(mount.epipolar.px), "image point")
                yield Paragraph(
                    f"Camera {mount.camera}: RMS distance of {points} from the epipolar lines of camera "
                    f"{rig.reference} {significant(mount.epipolar.rms_px)} px."
                )
    yield FoldedParts("Correlations and significance of camera parameters", *_correlations(f), in_text=True)


def _correlations(f: Findings) -> Iterator[Part]:
    s, strong = f.statistics, f.result.orientation_correlations
    if s.camera_correlations:
        yield _pairs(s.camera_correlations)
        yield Note(
            "Parameters correlated this strongly cannot be separated: each compensates for errors of the "
            "other."
        )
    else:
        yield Paragraph(f"No two parameters of a camera are correlated beyond {OVER}.")
    others = [pair for pair in s.correlations if pair not in s.camera_correlations]
    if others:
        summary = f"{len(others)} strong correlations within the exterior orientation of a photograph"
        yield FoldedParts(summary, _pairs(others), in_text=True)
    if strong:
        heads = (Column("camera parameter"), Column("strongly correlated with"))
        rows = [
            (
                correlation.parameter,
                correlation.partners,
                100 * correlation.largest,
                f"with {correlation.part} of {correlation.image}",
            )
            for correlation in strong
        ]
        yield Table((*heads, Column("largest correlation", "", "%", "+.1f"), Column("")), rows)
        yield Note(
            "The photographs can hardly separate these, such as c from Z0 in a flat network. Photographs "
            "rolled about their axis, convergent photographs, and an object with depth can."
        )
    else:
        yield Paragraph(
            f"No camera parameter is correlated with the exterior orientation of a photograph beyond {OVER}."
        )
    tests = ", ".join(
        f"{test.parameter} of {test.camera} ({fixed(test.t, 1)}, p {fixed(test.probability, 2)})"
        for test in s.not_significant
    )
    level = percent(f.result.adjustment.false_alarm)
    yield Paragraph(
        f"Not significantly different from 0 (t test, {level}; in brackets the value over its standard "
        f"deviation): {tests}. Holding any one of them at 0 would worsen the fit by no more than chance."
        if tests
        else f"All adjusted parameters differ significantly from 0 (t test, {level})."
    )


def _pairs(correlations: Iterable[Correlation]) -> Table:
    rows = [(correlation.first, correlation.second, 100 * correlation.value) for correlation in correlations]
    heads = (Column("parameter"), Column("and"), Column("correlation", "", "%", "+.1f"))
    return Table(heads, rows, most=MAX_CORRELATIONS, all_in="summary.json")


COMPONENTS = {
    "observations": Column("observations", format=str),
    "redundancy": Column("redundancy", format="z.1f"),
    "sigma0": Column("sigma0", format=".3f", unknown="not known"),
}


def component_parts(f: Findings) -> Iterator[Part]:
    """Yield the variance components of kinds, sources, cameras and photographs, largest first."""
    yield Note(
        "Variance components: sigma0 of a group over the value stated beforehand. A group far above the "
        "others was measured with less precision, or does not fit."
    )
    rows = sorted(component_rows(f.statistics), key=lambda row: -np.nan_to_num(row[-1]))
    named = {"kind": "kind of observation", "source": "source of image points"}
    for kind in ("kind", "source", "camera", "photograph"):
        name = named.get(kind, kind)
        columns = columns_of(VARIANCE_COMPONENTS, {"group": Column(name), **COMPONENTS})
        members = [row for row in rows if row[0] == kind]
        if kind not in named or len(members) > 1:
            table = Table(columns, members, all_in=VARIANCE_COMPONENTS.file)
            yield FoldedParts(f"Variance components by {name}", table, in_text=True)
