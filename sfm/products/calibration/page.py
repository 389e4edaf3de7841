"""The page of a calibration: can I trust this camera, where, what is wrong, and what next."""

from __future__ import annotations

import re
import shlex
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import LogNorm
from scipy.spatial import ConvexHull

from sfm.model.conventions import finer_unit
from sfm.model.display import counted, listed
from sfm.model.distortion.models import Role
from sfm.model.distributions import normal_sf
from sfm.model.remarks.remark import of_kind
from sfm.model.remarks.verdict import Level, Verdict, judge
from sfm.products.calibration.calibration import (
    KNOWN_FACTOR,
    NOT_ADJUSTED,
    Calibration,
    CameraCalibration,
    ObjectShape,
)
from sfm.products.calibration.crossvalidation import HalvesDifference
from sfm.products.calibration.poses import NextPoses, Pose
from sfm.report.figures.comparisons import difference_figure
from sfm.report.figures.plot_data import Plot
from sfm.report.figures.plots import (
    BAR_FRACTION,
    BETWEEN_IN,
    BLUE,
    BOTTOM_IN,
    GREY,
    LEFT_IN,
    ORANGE,
    RED,
    RIGHT_IN,
    SHADES,
    TOP_IN,
    WIDTH_IN,
    entitled,
    plot,
    single_panel_figure,
    two_panel_figure,
)
from sfm.report.page import (
    Column,
    Heading,
    Mark,
    Note,
    Page,
    Paragraph,
    Part,
    Section,
    Statement,
    Table,
    columns,
    facts,
)
from sfm.report.phrases import finer_unit_of, fixed, length_of, significant, with_exponent

HEADLINES: Mapping[Level, str] = {
    "good": "{found}.",
    "fair": "{found}. Read the remarks first.",
    "bad": "Do not trust this calibration.",
}
NAME = "calibration"
LEVELS = 10  # contours, in equal ratios
CURVE = 25  # distances of the curve
WIDEST = 30.0  # of the curve, in distances of the photographs


def page(calibration: Calibration, *, folder: str = "RESULT") -> Page:
    """Return the page of a calibration.

    Args:
        calibration: what a survey says about its cameras.
        folder: folder of the result as the user names it, for the commands on the page.
    """
    result = calibration.result
    return Page(
        NAME,
        "Calibration",
        result.survey,
        verdict_of(calibration),
        (
            Section("Can I trust it?", *_trust(calibration), key="trust"),
            Section("Where?", *_where(calibration), key="where"),
            Section("What is wrong?", *_wrong(calibration, folder), key="wrong"),
            Section("What next?", *_next(calibration, folder), key="next"),
        ),
        summary=summary_of(calibration),
        files=(_map_table(calibration), _field_table(calibration)),
    )


def verdict_of(calibration: Calibration) -> Verdict:
    """Return the verdict on a calibration."""
    statements = []
    for camera in calibration.cameras:
        middle, corner = _sigmas(camera, np.inf)
        halves = calibration.validation.clearest(camera.name)
        stated = f"Camera {camera.name} is not determined"
        if np.isfinite(corner):
            stated = (
                f"Camera {camera.name} is known to {significant(middle)} px in the middle and "
                f"{significant(corner)} px in the worst corner (1 sigma, far points)"
            )
            if halves is not None and halves.probability < calibration.level:
                stated += f", but halves of its photographs differ by {significant(halves.rms_px)} px"
        statements.append(stated)
    found = ". ".join(statements)
    return judge(calibration.remarks, {level: text.format(found=found) for level, text in HEADLINES.items()})


def _sigmas(camera: CameraCalibration, distance: float) -> tuple[float, float]:
    """Return sigma of projection in the middle and in the worst corner, px."""
    middle, corner = (camera.known.sigma_at(xy, distance) for xy in (camera.middle, camera.corners))
    return float(middle.max()), float(corner.max())


def _share(camera: CameraCalibration, distance: float) -> float:
    """Return the share of the format in which the camera is known."""
    return float(camera.known_region(distance)[1].mean())


def _at(distance: float, unit: str) -> str:
    return "infinity" if np.isinf(distance) else length_of(distance, unit)


def _focal(camera: CameraCalibration) -> Iterator[tuple[str, float, float]]:
    """Yield name, value and sigma of each focal length, px."""
    pixel = camera.camera.pixel_mm
    for parameter in camera.parameters:
        if parameter.parameter.role is Role.FOCAL:
            factor = 1 / float(np.mean(pixel)) if camera.camera.in_mm else 1.0
            name = "f" if camera.camera.in_mm else parameter.name
            yield name, factor * parameter.value, factor * parameter.sigma


def _trust(calibration: Calibration) -> Iterator[Part]:
    unit = calibration.result.length_unit
    if not calibration.cameras:
        for said in of_kind(calibration.remarks, *NOT_ADJUSTED):
            yield Statement(said.text, "bad")
        return
    a = calibration.result.adjustment
    for camera in calibration.cameras:
        width, height = camera.camera.size_px
        degrees = [fixed(angle, 1) for angle in camera.degrees]
        x, y = camera.camera.principal_point_px
        rows: list[tuple[str, str]] = [
            (
                "photographs",
                f"{camera.photographs} of {width} x {height} px, {counted(len(camera.xy), 'image point')}",
            ),
            ("model", f"{camera.camera.model}, adjusted: {', '.join(_free(camera)) or 'nothing'}"),
        ]
        for name, value, sigma in _focal(camera):
            stated = (
                " ± ".join(with_exponent(value, sigma)) + " px" if np.isfinite(sigma) else "not determined"
            )
            rows.append((f"{name}, focal length", stated))
        pixel_mm = float(np.mean(camera.camera.pixel_mm))
        c_mm = camera.camera.c_px * pixel_mm
        rows += [
            ("c, principal distance", f"{c_mm:.5g} mm with pixels of {1000 * pixel_mm:.4g} µm"),
            ("angle of view", f"{degrees[0]} x {degrees[1]} deg, diagonal {degrees[2]} deg"),
            ("principal point", f"{x:.2f}, {y:.2f} px from the upper left corner"),
            ("image points", f"sigma0 {a.sigma0_px:.3f} px, RMS residual {a.rms_px:.3f} px"),
        ]
        for distance in reversed(calibration.distances):
            middle, corner = _sigmas(camera, distance)
            stated = "not determined"
            if np.isfinite(corner):
                stated = (
                    f"1 sigma {significant(middle)} px in the middle, {significant(corner)} px in the worst "
                    f"corner; known in {100 * _share(camera, distance):.0f} % of the format"
                )
            rows.append((f"projection at {_at(distance, unit)}", stated))
        halves = calibration.validation.clearest(camera.name)
        if halves is not None:
            rows.append(
                (
                    "halves of the photographs",
                    f"differ by {significant(halves.rms_px)} px RMS, "
                    f"{significant(halves.expected_px)} px expected, in the clearest of "
                    f"{counted(len(calibration.validation.of_camera(camera.name)), 'division')}",
                )
            )
        yield Heading(f"Camera {camera.name}")
        yield facts(rows)
    yield Note(
        "Uncertainty of projection: how far a point at this distance may be imaged from where the camera "
        "predicts it, one standard deviation per coordinate. The point is fixed to the object through each "
        "photograph, so that what poses absorb does not count. It is true as far as the model fits; see what "
        f"is wrong. Known: between image points, with a sigma of at most {KNOWN_FACTOR:g} times the best."
    )


def _free(camera: CameraCalibration) -> list[str]:
    return [name for name, free in zip(camera.camera.names, camera.camera.free, strict=True) if free]


def _where(calibration: Calibration) -> Iterator[Part]:
    for number, camera in enumerate(calibration.cameras):
        if not np.isfinite(camera.known.covariance).all():
            yield Statement(f"Camera {camera.name} is not determined: it is known nowhere.", "bad")
            continue
        yield _map_plot(calibration, camera, number)
    if not calibration.cameras:
        yield Statement("No camera is known anywhere, as none is calibrated.", "bad")
    determined = [camera for camera in calibration.cameras if np.isfinite(camera.known.covariance).all()]
    if determined:
        yield _curve_plot(calibration, determined)


def _map_plot(calibration: Calibration, camera: CameraCalibration, number: int) -> Plot:
    unit = calibration.result.length_unit
    distances = (*calibration.distances[-2:],)
    figure = two_panel_figure(_height([camera], share=0.8))
    panels = figure.subplots(1, 2, squeeze=False).ravel()
    for panel, distance in zip(panels, distances, strict=True):
        x, y, sigma = camera.known.map_at(distance)
        known = sigma[np.isfinite(sigma) & (sigma > 0)]
        levels = np.geomspace(known.min(), known.max() * (1 + 1e-6), LEVELS)
        drawn = panel.contourf(x, y, sigma, levels=levels, norm=LogNorm(), cmap=SHADES)
        _format(panel, camera, f"{camera.name}: sigma at {_at(distance, unit)}")
        panel.plot(*camera.xy[:: max(1, len(camera.xy) // 4000)].T, ".", color="black", ms=1, alpha=0.4)
        _, inside = camera.known_region(distance)
        panel.contour(
            x, y, inside.reshape(sigma.shape).astype(float), levels=[0.5], colors=[RED], linewidths=1.5
        )
        bar = figure.colorbar(drawn, ax=panel, fraction=BAR_FRACTION, ticks=levels, format="%.2g")
        bar.set_label("sigma [px]")
    return plot(
        f"projection-{number}",
        f"Camera {camera.name}: uncertainty of projection at two distances, 1 sigma per coordinate. Red: the "
        "region in which the camera is known. Dots are the image points; beyond them the model extrapolates.",
        figure,
    )


def _curve_plot(calibration: Calibration, cameras: Sequence[CameraCalibration]) -> Plot:
    figure = single_panel_figure(3.6)
    axes = figure.subplots()
    unit = calibration.result.length_unit
    factor, fine = finer_unit(unit, max(camera.far for camera in cameras))
    for k, camera in enumerate(cameras):
        colour = (BLUE, ORANGE, RED, GREY)[k % 4]
        distances = np.geomspace(camera.near / 3, WIDEST * camera.far, CURVE)
        for place, line in (("middle", "-"), ("worst corner", "--")):
            pair = [_sigmas(camera, float(distance)) for distance in distances]
            index = 0 if place == "middle" else 1
            axes.plot(
                distances * factor,
                [sigmas[index] for sigmas in pair],
                line,
                color=colour,
                label=f"{camera.name}, {place}".replace("$", r"\$"),
            )
        axes.axvspan(camera.near * factor, camera.far * factor, color=colour, alpha=0.08, lw=0)
    axes.set(xscale="log", yscale="log", xlabel=f"distance [{fine or 'object units'}]", ylabel="sigma [px]")
    axes.grid(color="#ddd", linewidth=0.5, which="both")
    axes.legend(fontsize=8)
    return plot(
        "projection-distance",
        "Uncertainty of projection by distance, 1 sigma per coordinate. Shaded: distances of the "
        "photographs.",
        figure,
    )


def _height(cameras: Sequence[CameraCalibration], rows: int = 1, *, share: float = 1.0) -> float:
    """Return the height of a figure of panels that show the format, in; `share` of their width is free."""
    width = (WIDTH_IN - LEFT_IN - RIGHT_IN - BETWEEN_IN) / 2
    aspect = max(camera.camera.size_px[1] / camera.camera.size_px[0] for camera in cameras)
    return TOP_IN + BOTTOM_IN + (rows - 1) * BETWEEN_IN + rows * width * share * aspect


def _format(panel: Axes, camera: CameraCalibration, title: str) -> None:
    """Set up a panel to show the format of a camera."""
    width, height = camera.camera.size_px
    panel.set(xlim=(-0.5, width - 0.5), ylim=(height - 0.5, -0.5), xlabel="x [px]", ylabel="y [px]")
    panel.set_aspect("equal")
    entitled(panel, title.replace("$", r"\$"))


def _wrong(calibration: Calibration, folder: str) -> Iterator[Part]:
    if calibration.cameras:
        yield from _wrong_with_cameras(calibration, folder)
    if calibration.shape is not None:
        yield Heading("Board" if calibration.shape.flat else "Object")
        yield from _shape_parts(calibration, calibration.shape)
    elif not calibration.cameras:
        yield Paragraph("Nothing can be tested without a calibrated camera.")


def _wrong_with_cameras(calibration: Calibration, folder: str) -> Iterator[Part]:
    level = calibration.level
    yield Heading("Model")
    for camera in calibration.cameras:
        yield from _model_parts(camera, level, folder)
    yield Note(
        "A parameter is needed if it raises ln of the likelihood by more than its price, which grows with "
        "the number of image points. The same rule chose a central or a fisheye lens in the draft. "
        "Insufficient: mean residuals over the format are beyond chance, and a further parameter explains "
        "them or they exceed the uncertainty of projection."
    )
    fields = [camera for camera in calibration.cameras if len(camera.field.mean)]
    if fields:
        yield Heading("Residuals over the format")
        yield _field_plot(fields, level)
        for camera in fields:
            field = camera.field
            count = int(field.significant(level).sum())
            yield Paragraph(
                f"Camera {camera.name}: {count} of {counted(len(field.mean), 'cell')} with a significant "
                f"mean; the field beyond chance is {significant(field.rms_px)} px RMS ({_p(field.whole)})."
            )
    yield Heading("Halves of the photographs")
    yield from _halves_parts(calibration)


def _p(probability: float) -> str:
    return "p < 0.001" if probability < 1e-3 else f"p = {probability:.3f}"


def _model_parts(camera: CameraCalibration, level: float, folder: str) -> Iterator[Part]:
    rows: list[Sequence[object]] = []
    for alternative in camera.alternatives:
        word, names = "with" if alternative.added else "without", ", ".join(alternative.parameters)
        if not np.isfinite(alternative.gain):
            said = Mark("no solution", "fair")
        elif alternative.added:
            said = Mark("needed: add it", "fair") if alternative.borne else Mark("not borne", "good")
        else:
            said = Mark("needed", "good") if alternative.borne else Mark("not needed", "fair")
        rows.append((f"{word} {names}", alternative.gain, alternative.price, said))
    heads = (
        Column("model"),
        Column("gain of ln likelihood", format=significant, unknown=""),
        Column("price", format=significant),
        Column("photographs say"),
    )
    insufficient, field = camera.is_insufficient(level), camera.field
    needless = [
        n
        for a in camera.alternatives
        if not a.added and not a.borne and np.isfinite(a.gain)
        for n in a.parameters
    ]
    suffices = "Over the format, " if camera.missing else "It suffices: "
    words = [f"Camera {camera.name}: {camera.camera.model} with {', '.join(_free(camera))}."]
    if insufficient:
        words.append(
            f"It is insufficient: the residuals contradict it, by {significant(field.rms_px)} px RMS "
            f"({_p(field.whole)})."
        )
    elif field.whole < level:
        words.append(
            f"{suffices}residuals depend on the place in the format by {significant(field.rms_px)} px RMS "
            f"({_p(field.whole)}), less than the uncertainty of projection."
        )
    elif np.isfinite(field.whole):
        words.append(f"{suffices}residuals do not depend on the place in the format ({_p(field.whole)}).")
    else:
        words.append("Its residuals are not tested: no part of the format has points of enough photographs.")
    if camera.splined is not None:
        splined = camera.splined
        words.append(
            f"A splined camera describes the lens better: its surface departs from {camera.camera.model} by "
            f"{significant(splined.sigma_px)} px, image points determine {splined.determined:.0f} of its "
            f"{int(splined.camera.free.sum())} coefficients on a grid of {splined.knots} x {splined.knots}, "
            "and sigma0 falls to "
            f"{significant(splined.adjustment.sigma0_px)} px. Use it with --camera "
            f"{shlex.quote(f'{folder}/{splined_folder(camera)}')}."
        )
    if camera.missing:
        words.append(f"The photographs demand {listed(camera.missing)}: add to free in the survey file.")
    if needless:
        words.append(f"They do not need {listed(needless)}, which may be left out.")
    trusted = not (insufficient or camera.missing) and np.isfinite(field.whole)
    yield Statement(" ".join(words), "good" if trusted else "fair")
    yield Table(heads, rows)


def splined_folder(camera: CameraCalibration) -> str:
    """Return the name of the folder with a splined camera, in that of the result."""
    return "splined-" + re.sub(r"[^\w.-]+", "-", camera.name)


def _field_plot(cameras: Sequence[CameraCalibration], level: float) -> Plot:
    rows = -(-len(cameras) // 2)
    figure = two_panel_figure(_height(cameras, rows), rows=rows)
    panels = figure.subplots(rows, 2, squeeze=False).ravel()
    for panel in panels[len(cameras) :]:
        panel.set_axis_off()
    for panel, camera in zip(panels, cameras, strict=False):
        field = camera.field
        largest = float(np.linalg.norm(field.mean, axis=1).max()) or 1.0
        factor = float(f"{max(camera.camera.size_px) / 14 / largest:.1g}")
        colours = np.where(field.significant(level), RED, GREY)
        panel.quiver(
            *field.centre.T, *(factor * field.mean).T, color=colours, angles="xy", scale_units="xy", scale=1,
            width=0.004,
        )  # fmt: skip
        _format(panel, camera, f"{camera.name}: mean residuals, × {factor:g}")
    return plot(
        "residual-field",
        "Mean residuals of the cells of the format, enlarged by the factor after ×. Red: significant, by the "
        "precision of the image points and by the scatter of the photographs.",
        figure,
    )


def _halves_parts(calibration: Calibration) -> Iterator[Part]:
    validation = calibration.validation
    heads = (
        Column("camera"),
        Column("halves"),
        Column("photographs"),
        Column("difference", unit="px", format=significant),
        Column("expected", unit="px", format=significant),
        Column("over expected", format=".2f"),
        Column("by chance"),
    )

    def row(halves: HalvesDifference) -> tuple[object, ...]:
        contradicts = halves.probability < calibration.level
        said = Mark(_p(halves.probability), "fair" if contradicts else "good")
        of_both = " and ".join(map(str, halves.photographs))
        return (
            halves.camera, halves.division, of_both, halves.rms_px, halves.expected_px, halves.ratio, said,
        )  # fmt: skip

    if validation.differences:
        yield Table(heads, [row(halves) for halves in validation.differences])
        yield Note(
            "Each half is adjusted by itself. Difference: RMS of where the two cameras image the same rays, "
            "after the best rotation. Expected: by the covariances of both. Over expected: all modes in "
            "which they can differ, weighted equally; about 1 if nothing but chance differs."
        )
    reasons = dict.fromkeys(why for _, why in validation.untested)
    for why in reasons:
        yield Paragraph(f"Not tested: {why}.")


def _shape_parts(calibration: Calibration, shape: ObjectShape) -> Iterator[Part]:
    unit = calibration.result.length_unit
    factor, fine = finer_unit_of(unit, shape.difference)
    rms = float(np.sqrt((shape.difference**2).sum(axis=1).mean()))
    sigma = float(np.sqrt((shape.sigma**2).sum(axis=1).mean()))
    variance = np.diagonal(calibration.result.network.control.complete.covariance, axis1=1, axis2=2)
    held = not (variance > 0).any()
    rows = [
        ("points", str(len(shape.points))),
        (
            "found minus given, by the image points alone",
            f"{significant(rms * factor)} {fine} RMS, {significant(sigma * factor)} {fine} expected",
        ),
    ]
    if shape.flat:
        off, off_sigma = shape.off_plane
        sigmas = np.abs(off) / np.maximum(off_sigma, 1e-300)
        worst = int(np.abs(off).argmax())
        far = f"{significant(abs(off[worst]) * factor)} {fine}"
        if 2 * len(off) * float(normal_sf(sigmas.max())) < calibration.level:
            remedy = (
                "They were held in it, and the camera is wrong by that: state "
                f"{length_of(rms / 3**0.5, unit)} as their standard deviation (plate_sigma of a plate)."
                if held
                else "They were adjusted, so that the camera does not depend on a true plane."
            )
            yield Statement(
                f"The board is not flat: its points lie up to {far} off a plane. {remedy} Fix the print to a "
                "rigid plate before you photograph it again.",
                "bad" if held else "fair",
            )
        rows.append(
            (
                "largest distance from the plane",
                f"{far}, at point {calibration.result.network.points[shape.points[worst]]}, "
                f"{significant(sigmas[worst], 2)} sigma",
            )
        )
    stated = float(np.sqrt(variance.max(initial=0.0)))
    rows.append(
        (
            "in the adjustment",
            "coordinates held as given"
            if held
            else f"coordinates adjusted, given with {length_of(stated, unit)}",
        )
    )
    yield facts(rows)
    figure = difference_figure(shape.given, shape.difference, shape.significant, unit)
    words = "across its plane as colours" if shape.flat else "across its main plane as colours"
    yield plot(
        "board",
        f"Found minus given coordinates, in the plane as arrows, {words}. Red arrows: beyond three sigma.",
        figure,
    )


def _next(calibration: Calibration, folder: str) -> Iterator[Part]:
    unit = calibration.result.length_unit
    unknown = [camera.name for camera in calibration.cameras if not camera.next.poses]
    if not calibration.cameras:
        unknown = [camera.name for camera in calibration.result.estimate.cameras]
    for name in unknown:
        yield Statement(
            f"Camera {name}: photograph the object tilted by 30 to 45 degrees, from several sides, in the "
            "corners of the format and turned by 90 degrees.",
            "fair",
        )
    for number, camera in enumerate(calibration.cameras):
        further = camera.next
        if not further.poses:
            continue
        yield Heading(f"Next {counted(len(further.poses), 'photograph')} with camera {camera.name}")
        heads = columns("photograph", "object at", "tilt", "camera turned", ">distance", ">worst corner then")
        rows = [
            (
                *(str(k + 1), _place(pose), _tilt(pose)),
                *(f"{pose.roll_deg:.0f} deg" if pose.roll_deg else "no", length_of(pose.distance, unit)),
                f"{significant(after)} px",
            )
            for k, (pose, after) in enumerate(zip(further.poses, further.after, strict=True))
        ]
        yield Table(heads, rows)
        yield _pose_plot(camera, further, number)
        yield Note(
            f"Worst corner now: {significant(further.before)} px (1 sigma, far points). Of all views of a "
            "grid of tilts, distances and places, these lower it most. Keep focus and zoom."
        )
    if verdict_of(calibration).level == "bad":
        return
    folder = shlex.quote(folder)
    yield Heading("Use it")
    yield facts(
        [
            ("in a survey", f"kolinear run SURVEY.toml --camera {folder}"),
            ("with changes allowed", f"kolinear run SURVEY.toml --camera {folder} --camera-weighted"),
            ("in other programs", f"kolinear convert {folder} OUT --to FORMAT"),
        ]
    )


def pose_words(pose: Pose, unit: str) -> str:
    """Return how to take a photograph, in words."""
    turned = f", camera turned by {pose.roll_deg:.0f} deg" if pose.roll_deg else ""
    return (
        f"object at {_place(pose)}, tilted {_tilt(pose)}{turned}, distance {length_of(pose.distance, unit)}"
    )


def _place(pose: Pose) -> str:
    x, y = pose.place
    across = "left" if x < 0.4 else "right" if x > 0.6 else ""
    up = "upper" if y < 0.4 else "lower" if y > 0.6 else ""
    return " ".join(part for part in (up, across) if part) or "middle"


def _tilt(pose: Pose) -> str:
    a, b = pose.tilt_deg
    parts = []
    if a:
        parts.append(f"{abs(a):.0f} deg from {'below' if a > 0 else 'above'}")
    if b:
        parts.append(f"{abs(b):.0f} deg from the {'right' if b > 0 else 'left'}")
    return ", ".join(parts) or "frontal"


def _pose_plot(camera: CameraCalibration, further: NextPoses, number: int) -> Plot:
    rows = -(-len(further.poses) // 2)
    figure = two_panel_figure(_height([camera], rows), rows=rows)
    panels = figure.subplots(rows, 2, squeeze=False).ravel()
    for panel in panels[len(further.poses) :]:
        panel.set_axis_off()
    for k, (panel, pose) in enumerate(zip(panels, further.poses, strict=False)):
        xy = pose.xy[np.isfinite(pose.xy[:, 0])]
        panel.plot(*camera.xy[:: max(1, len(camera.xy) // 4000)].T, ".", color=GREY, ms=1, alpha=0.4)
        if len(xy) > 3:
            hull = xy[ConvexHull(xy).vertices]
            panel.fill(*hull.T, color=BLUE, alpha=0.15)
        panel.plot(*xy.T, "o", color=BLUE, ms=3)
        panel.plot(*xy[:1].T, "o", color=RED, ms=6)
        _format(panel, camera, f"{k + 1}")
    return plot(
        f"next-{number}",
        f"What the finder of camera {camera.name} should show, one after the other. Red: the first point of "
        "the object. Grey: image points so far.",
        figure,
    )


def _map_table(calibration: Calibration) -> Table:
    heads = tuple(Column(None, name) for name in ("camera", "distance", "x_px", "y_px", "sigma_px", "known"))
    rows: list[tuple[Any, ...]] = []
    for camera in calibration.cameras:
        for distance in calibration.distances:
            xy, inside = camera.known_region(distance)
            sigma = camera.known.sigma_at(xy, distance)
            for place, s, known in zip(xy, sigma, inside, strict=True):
                rows.append((camera.name, distance, *place, s, int(known)))
    return Table(heads, rows, "projection_uncertainty")


def _field_table(calibration: Calibration) -> Table:
    names = ("camera", "x_px", "y_px", "vx_px", "vy_px", "sigma_px", "image_points", "photographs", "p")
    rows = [
        (camera.name, *centre, *mean, sigma, count, photographs, p)
        for camera in calibration.cameras
        for field in [camera.field]
        for centre, mean, sigma, count, photographs, p in zip(
            field.centre, field.mean, field.sigma, field.count, field.photographs, field.probability,
            strict=True,
        )
    ]  # fmt: skip
    return Table(tuple(Column(None, name) for name in names), rows, "residual_field")


def summary_of(calibration: Calibration) -> dict[str, Any]:
    """Return the figures of a calibration for programs."""
    shape = calibration.shape
    return {
        "survey": calibration.result.survey,
        "length_unit": calibration.result.length_unit,
        "verdict": verdict_of(calibration).entry,
        "cameras": [_camera_summary(calibration, camera) for camera in calibration.cameras],
        "object_shape": None
        if shape is None
        else {
            "points": len(shape.points),
            "rms": float(np.sqrt((shape.difference**2).sum(axis=1).mean())),
            "expected": float(np.sqrt((shape.sigma**2).sum(axis=1).mean())),
            "largest_off_plane": float(np.abs(shape.off_plane[0]).max()) if shape.flat else None,
        },
    }


def _camera_summary(calibration: Calibration, camera: CameraCalibration) -> dict[str, Any]:
    a = calibration.result.adjustment
    return {
        "camera": camera.name,
        "model": camera.camera.model,
        "size_px": camera.camera.size_px,
        "photographs": camera.photographs,
        "image_points": len(camera.xy),
        "focal_px": {name: {"value": value, "sigma": sigma} for name, value, sigma in _focal(camera)},
        "c_mm": camera.camera.c_px * float(np.mean(camera.camera.pixel_mm)),
        "principal_point_px": camera.camera.principal_point_px,
        "angles_of_view_deg": camera.degrees,
        "sigma0_px": a.sigma0_px,
        "parameters": {
            parameter.name: {"value": parameter.value, "sigma": parameter.sigma, "unit": parameter.unit}
            for parameter in camera.parameters
        },
        "projection": [
            {
                "distance": distance if np.isfinite(distance) else "infinity",
                "middle_px": _sigmas(camera, distance)[0],
                "worst_corner_px": _sigmas(camera, distance)[1],
                "known_share": _share(camera, distance),
            }
            for distance in calibration.distances
        ],
        "residual_field": {
            "rms_px": camera.field.rms_px,
            "p": camera.field.whole,
            "insufficient": camera.is_insufficient(calibration.level),
        },
        "models": [
            {
                "added": alternative.added,
                "parameters": alternative.parameters,
                "gain": alternative.gain,
                "price": alternative.price,
                "needed": alternative.borne,
            }
            for alternative in camera.alternatives
        ],
        "splined": None
        if camera.splined is None
        else {
            "folder": splined_folder(camera),
            "sigma_px": camera.splined.sigma_px,
            "determined": camera.splined.determined,
            "knots": camera.splined.knots,
            "gain": camera.splined.gain,
            "price": camera.splined.price,
            "sigma0_px": camera.splined.adjustment.sigma0_px,
        },
        "halves": [
            {
                "division": halves.division,
                "photographs": halves.photographs,
                "rms_px": halves.rms_px,
                "expected_px": halves.expected_px,
                "largest_px": halves.largest_px,
                "ratio": halves.ratio,
                "p": halves.probability,
            }
            for halves in calibration.validation.of_camera(camera.name)
        ],
        "next_poses": {
            "worst_corner_px": camera.next.before,
            "poses": [
                {
                    "position": pose.position,
                    "rotation": pose.rotation,
                    "place": pose.place,
                    "tilt_deg": pose.tilt_deg,
                    "roll_deg": pose.roll_deg,
                    "distance": pose.distance,
                    "worst_corner_px": after,
                }
                for pose, after in zip(camera.next.poses, camera.next.after, strict=True)
            ],
        },
    }
