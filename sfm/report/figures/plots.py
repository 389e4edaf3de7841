"""Pictures of an adjustment: network, residuals over the format, residual statistics, photographs."""

from __future__ import annotations

import io
from collections.abc import Callable, Sequence

import numpy as np
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import LineCollection
from matplotlib.colors import ListedColormap, LogNorm
from matplotlib.figure import Figure
from PIL import Image

from sfm.model.conventions import SUPERSCRIPTS, AnyArray, FloatArray, IntArray
from sfm.report.figures.plot_data import Plot, PlotData

BLUE, RED, GREY, GREEN, ORANGE = "#1f5fa8", "#c8372d", "#8a8f98", "#2b7a4b", "#d98a1f"
DPI = 110
COMPRESSION = 2  # of PNG, 1 to 9: more takes time and hardly shrinks lines on white
WIDTH_IN = 9.6  # of pictures with two panels
ALONE_IN = 6.0  # of pictures with one panel
LEFT_IN, RIGHT_IN, BOTTOM_IN, TOP_IN, BETWEEN_IN = 0.9, 0.15, 0.55, 0.35, 1.05  # margins
BAR_FRACTION = 0.2  # of a panel, for its colour bar with labels
LETTER_IN = 0.065  # width of a letter in the names of photographs
# Large values contrast most with the paper and small ones still do, on light pages and inverted on dark ones.
SHADES = ListedColormap(colormaps["viridis"](np.linspace(0.8, 0.0, 256)))
CAMERA_COLOURS = (BLUE, ORANGE, GREEN, "#7a4fa3", "#b0567a")
MAX_NAMED = 60  # photographs whose names are legible
PLACES = 200  # across a picture of points; a third of a dot each
MAX_ARROWS = 4000  # more residual vectors than this only blacken the picture
LEVELS = 11  # contours of the projection uncertainty, in equal ratios
OUTSIDE = 0.02  # part of the photograph below the lowest contour
CELLS = 12  # cells of the grid of mean residuals along the longer side
TITLES = ("Plan", "Elevation")
FLAT_COSINE = 0.94  # within 20 degrees of Z the object's main plane is drawn as X and Y


def all_plots(shown: PlotData) -> tuple[Plot, ...]:
    """Draw every picture of the report."""
    drawn: tuple[tuple[str, str, Callable[[PlotData], Figure]], ...] = (
        ("network", _NETWORK, network_figure),
        ("residuals", _RESIDUALS, residual_figure),
        ("distribution", _DISTRIBUTION, distribution_figure),
        ("photographs", _PHOTOGRAPHS, photograph_figure),
    )
    if np.isfinite(shown.sigma).any():
        drawn += (("precision", _PRECISION, precision_figure),)
    if any(shown.projection):
        drawn += (("projection", _PROJECTION, projection_figure),)
    if shown.epipolar:
        drawn += (("epipolar", _EPIPOLAR, epipolar_figure),)
    return tuple(plot(stem, caption, draw(shown)) for stem, caption, draw in drawn)


def plot(stem: str, caption: str, figure: Figure) -> Plot:
    """Draw a figure, and cut it into its panels if `two_panel_figure` made it."""
    figure.set_dpi(DPI)
    canvas = FigureCanvasAgg(figure)
    canvas.draw()  # type: ignore[no-untyped-call]
    pixels = np.asarray(canvas.buffer_rgba())[:, :, :3]  # type: ignore[no-untyped-call]
    specs = [panel.get_subplotspec() for panel in figure.axes if panel.axison]
    shown = [spec.get_topmost_subplotspec() for spec in specs if spec is not None]
    grid = shown[0].get_gridspec()
    _, tops, lefts, _ = (np.asarray(edge) for edge in grid.get_grid_positions(figure))
    width, height = figure.get_size_inches() * DPI
    # edges of the panels, px, each with its labels
    x = [0, *np.rint(lefts[1:] * width - LEFT_IN * DPI).astype(int), round(width)]
    y = [0, *np.rint((1 - tops[1:]) * height - TOP_IN * DPI).astype(int), round(height)]
    positions = dict.fromkeys((spec.rowspan.start, spec.colspan.start) for spec in shown)
    panels = tuple(_png(pixels[y[r] : y[r + 1], x[c] : x[c + 1]]) for r, c in positions)
    return Plot(stem, caption, _png(pixels), panels)


def _png(pixels: AnyArray) -> bytes:
    """Return a picture, (h, w, 3), as PNG."""
    buffer = io.BytesIO()
    Image.fromarray(pixels).save(buffer, "PNG", compress_level=COMPRESSION)
    return buffer.getvalue()


def single_panel_figure(height_in: float) -> Figure:
    """Return a figure for one panel, narrow enough to be legible on a telephone."""
    return Figure(figsize=(ALONE_IN, height_in), layout="constrained")


def two_panel_figure(height_in: float, *, rows: int = 1, bottom_in: float = BOTTOM_IN) -> Figure:
    """Return a figure with margins for rows of two panels; matplotlib's layouts would draw twice."""
    each_in = (height_in - TOP_IN - bottom_in - (rows - 1) * BETWEEN_IN) / rows
    figure = Figure(figsize=(WIDTH_IN, height_in))
    figure.subplots_adjust(
        left=LEFT_IN / WIDTH_IN,
        right=1 - RIGHT_IN / WIDTH_IN,
        bottom=bottom_in / height_in,
        top=1 - TOP_IN / height_in,
        wspace=2 * BETWEEN_IN / (WIDTH_IN - LEFT_IN - RIGHT_IN - BETWEEN_IN),
        hspace=BETWEEN_IN / each_in,
    )
    return figure


def entitled(panel: Axes, title: str) -> None:
    """Put a title above a panel at a fixed height; otherwise matplotlib measures all labels to place it."""
    panel.set_title(title, y=1.0, fontsize=10)


_NETWORK = "Photographs (pyramids that open towards the object) and object points."
_RESIDUALS = (
    "Residual vectors over the format of each camera, enlarged by the factor after ×: all vectors, and the "
    "mean of each cell. A pattern in the means is distortion that the camera model does not describe."
)
_DISTRIBUTION = (
    "Residuals divided by their standard deviations, against the normal distribution, and residuals by "
    "distance from the centre of the photograph."
)
_PHOTOGRAPHS = "RMS residual per coordinate and number of accepted image points of each photograph."
_PRECISION = (
    "Precision of the object points: 1 sigma, root mean square of sX, sY, sZ; the 95 % value is 1.96 times "
    "as large. The colour scale runs from the smallest to the largest value."
)
_PROJECTION = (
    "Projection uncertainty of each camera: the standard deviation per image coordinate with which the "
    "calibration predicts where a direction is imaged, apart from a rotation of the camera. The 95 % value "
    "is 1.96 times as large. Dots are the image points; beyond them the distortion is extrapolated."
)

_EPIPOLAR = (
    "Distances of image points from the epipolar lines of the reference camera, for points seen by both at "
    "one moment. A pattern is distortion that the camera model does not describe, or photographs that were "
    "not taken at one moment."
)


def epipolar_figure(shown: PlotData) -> Figure:
    """Draw the distances from epipolar lines over the format of each mounted camera, two in a row."""
    figure, panels = _two_in_a_row(len(shown.epipolar))
    for panel, shown_map in zip(panels, shown.epipolar, strict=True):
        keep = slice(None, None, max(1, len(shown_map.xy) // MAX_ARROWS))
        limit = 3 * max(shown_map.rms_px, 1e-12)
        x, y = shown_map.xy[keep].T
        drawn = panel.scatter(x, y, 6, shown_map.distance_px[keep], cmap="coolwarm", vmin=-limit, vmax=limit)
        figure.colorbar(drawn, ax=panel, label="distance [px]", shrink=0.85, fraction=BAR_FRACTION)
        _show_format(panel, shown_map.size_px, f"{_plain(shown_map.name)}: RMS {shown_map.rms_px:.3g} px")
    return figure


def _two_in_a_row(count: int) -> tuple[Figure, list[Axes]]:
    """Return a figure with the given number of panels for photograph formats."""
    rows = -(-count // 2)
    figure = two_panel_figure(4.4 * rows, rows=rows)
    panels = figure.subplots(rows, 2, squeeze=False).ravel()
    for panel in panels[count:]:
        panel.set_axis_off()
    return figure, list(panels[:count])


def _show_format(panel: Axes, size_px: tuple[int, int], title: str) -> None:
    """Set up a panel to show the format of a photograph, below a title."""
    width, height = size_px
    panel.set(xlim=(-0.5, width - 0.5), ylim=(height - 0.5, -0.5), xlabel="x [px]", ylabel="y [px]")
    panel.set_aspect("equal")
    entitled(panel, title)


def network_figure(shown: PlotData) -> Figure:
    """Draw the network in plan and elevation."""
    axes_from_object, labels = plan_axes(shown.points, shown.position)
    points = shown.points @ axes_from_object.T
    position = shown.position @ axes_from_object.T
    size = 0.12 * float(np.median(np.linalg.norm(position - np.median(points, axis=0), axis=1)))
    figure = two_panel_figure(5.2)
    for panel, title, plane in zip(figure.subplots(1, 2), TITLES, ((0, 1), (0, 2)), strict=True):
        across, up = plane
        panel.plot(points[:, across], points[:, up], ".", color=GREY, markersize=4)
        for k, camera in enumerate(shown.cameras):
            of_camera = np.flatnonzero(shown.camera == k)
            colour = CAMERA_COLOURS[k % len(CAMERA_COLOURS)]
            # the edges of the viewing pyramid of each photograph, (edges, 2, 3)
            x, y = (side / 2 / camera.c_px for side in camera.size_px)
            corners = np.array([[-x, -y, -1], [x, -y, -1], [x, y, -1], [-x, y, -1]]) * size
            ends = []
            for i in of_camera:
                tips = shown.position[i] + corners @ shown.rotation[i].T
                for tip, next_tip in zip(tips, np.roll(tips, -1, axis=0), strict=True):
                    ends += [(shown.position[i], tip), (tip, next_tip)]
            edges = np.reshape(np.array(ends, dtype=float), (-1, 2, 3)) @ axes_from_object.T
            panel.add_collection(LineCollection(list(edges[:, :, plane]), colors=colour, linewidths=0.8))
            label = _plain(camera.name)
            panel.plot(*position[of_camera][:, plane].T, "o", color=colour, markersize=4, label=label)
        panel.margins(0.1)  # room for the names of the photographs
        panel.autoscale_view()
        _show_object(panel, labels[across], labels[up], shown.unit, title)
    figure.axes[0].legend(loc="upper right", fontsize=7)
    if len(position) <= MAX_NAMED:
        _write_names(figure.axes[0], [_plain(_short(name)) for name in shown.images], position[:, :2])
    return figure


def _show_object(panel: Axes, across: str, up: str, unit: str, title: str) -> None:
    """Set up a panel to show a plane of the object with named axes, below a title."""
    panel.set_aspect("equal", adjustable="datalim")
    panel.set(xlabel=f"{across} [{_plain(unit)}]", ylabel=f"{up} [{_plain(unit)}]")
    panel.grid(color="#ddd", linewidth=0.5)
    entitled(panel, title)


def _write_names(panel: Axes, names: Sequence[str], at: FloatArray) -> None:
    """Write names beside positions, preferably above and inwards; omit a name without room."""
    figure = panel.get_figure(root=True)
    assert figure is not None
    figure.draw_without_rendering()
    legend = panel.get_legend()
    taken = [legend.get_window_extent()] if legend is not None else []
    middle = sum(panel.get_xlim()) / 2
    for name, (x, y) in zip(names, at, strict=True):
        inwards = -1 if x > middle else 1
        for side, height in ((inwards, 4), (inwards, -9), (-inwards, 4), (-inwards, -9)):
            near = "left" if side > 0 else "right"
            text = panel.annotate(
                name,
                (x, y),
                (4 * side, height),
                textcoords="offset points",
                ha=near,
                fontsize=7,
                color="#444",
            )
            box = text.get_window_extent()
            if not any(box.overlaps(other) for other in taken):
                taken.append(box)
                break
            text.remove()


def precision_figure(shown: PlotData) -> Figure:
    """Draw the object points in plan and elevation, coloured by their standard deviation."""
    axes_from_object, labels = plan_axes(shown.points, shown.position)
    points = shown.points @ axes_from_object.T
    known = np.isfinite(shown.sigma)
    worst_last = np.argsort(np.where(known, shown.sigma, -1.0))
    worst_last = worst_last[known[worst_last]]
    figure = two_panel_figure(4.6)
    for panel, title, (across, up) in zip(figure.subplots(1, 2), TITLES, ((0, 1), (0, 2)), strict=True):
        panel.plot(points[~known, across], points[~known, up], ".", color=GREY, markersize=3)
        xy = points[worst_last][:, [across, up]]
        seen = _uncovered(xy)
        drawn = panel.scatter(*xy[seen].T, c=shown.sigma[worst_last[seen]], s=14, cmap=SHADES)
        drawn.set_clim(*shown.sigma[worst_last[[0, -1]]] if len(worst_last) else (None, None))
        label = f"sigma [{_plain(shown.sigma_unit)}]"
        figure.colorbar(drawn, ax=panel, label=label, shrink=0.85, fraction=BAR_FRACTION)
        _show_object(panel, labels[across], labels[up], shown.unit, title)
    return figure


def _uncovered(xy: FloatArray) -> IntArray:
    """Return the points, (n, 2), that are drawn last at each of the places: they cover the others."""
    if not len(xy):
        return np.arange(0)
    extent = max(float(np.ptp(xy, axis=0).max()), np.finfo(float).tiny)
    column, row = ((xy - xy.min(axis=0)) / extent * PLACES).astype(int).T
    _, last = np.unique((column * (PLACES + 1) + row)[::-1], return_index=True)
    return np.sort(len(xy) - 1 - last)


def projection_figure(shown: PlotData) -> Figure:
    """Draw the projection uncertainty of each adjusted camera over its format, two in a row."""
    adjusted = [k for k, projection in enumerate(shown.projection) if projection is not None]
    figure, panels = _two_in_a_row(len(adjusted))
    owner = shown.camera[shown.image]
    for panel, k in zip(panels, adjusted, strict=True):
        camera, projection = shown.cameras[k], shown.projection[k]
        assert projection is not None
        known = projection.sigma[projection.sigma > 0]
        levels = np.geomspace(np.quantile(known, OUTSIDE), known.max() * (1 + 1e-9), LEVELS)
        drawn = panel.contourf(
            projection.x,
            projection.y,
            projection.sigma,
            levels=levels,
            norm=LogNorm(),
            cmap=SHADES,
            extend="min",
        )
        xy = shown.xy[owner == k]
        panel.plot(*xy[:: max(1, len(xy) // MAX_ARROWS)].T, ".", color="black", markersize=1, alpha=0.5)
        bar = figure.colorbar(
            drawn, ax=panel, shrink=0.85, fraction=BAR_FRACTION, ticks=levels, format="%.2g"
        )
        bar.set_label("sigma [px]")
        _show_format(panel, camera.size_px, _plain(_clipped(camera.name)))
    return figure


def residual_figure(shown: PlotData) -> Figure:
    """Draw residual vectors over the format of each camera: each one, and the mean of each cell."""
    rows = len(shown.cameras)
    figure = two_panel_figure(4.4 * rows, rows=rows)
    panels = figure.subplots(rows, 2, squeeze=False)
    owner = shown.camera[shown.image]
    for k, camera in enumerate(shown.cameras):
        of_owner = owner == k
        xy, v = shown.xy[of_owner], shown.residuals[of_owner]
        width, height = camera.size_px
        name = _plain(_clipped(camera.name))
        factor = _round_factor(0.03 * width / max(_typical(v), 1e-12))
        keep = slice(None, None, max(1, len(xy) // MAX_ARROWS))
        _arrows(panels[k, 0], xy[keep], v[keep] * factor, BLUE)
        _show_format(panels[k, 0], camera.size_px, f"{name}: {len(xy)} residuals, × {factor:g}")
        side = max(width, height) / CELLS
        columns = int(np.ceil(width / side))
        cell = (xy // side).astype(int) @ (1, columns)
        number, index, count = np.unique(cell, return_inverse=True, return_counts=True)
        mean = np.stack([np.bincount(index, weights=v[:, a]) / count for a in (0, 1)], axis=1)
        centre = (np.stack([number % columns, number // columns], axis=1) + 0.5) * side
        mean, centre = mean[count >= 3], centre[count >= 3]
        if len(centre):
            factor = _round_factor(0.6 * width / CELLS / max(_typical(mean), 1e-12))
            _arrows(panels[k, 1], centre, mean * factor, RED)
        _show_format(panels[k, 1], camera.size_px, f"{name}: mean of each cell, × {factor:g}")
    return figure


def distribution_figure(shown: PlotData) -> Figure:
    """Draw the histogram of standardised residuals, and residuals by distance from the centre."""
    v, ray = shown.residuals, shown.from_centre
    figure = two_panel_figure(3.8)
    histogram, radial = figure.subplots(1, 2)
    z = shown.standardised[np.isfinite(shown.standardised)]
    bins = np.linspace(-5, 5, 41)
    histogram.hist(
        np.clip(z, -4.999, 4.999), bins=bins, density=True, color=BLUE, alpha=0.6, label="residuals"
    )
    t = np.linspace(-5, 5, 201)
    histogram.plot(t, np.exp(-(t**2) / 2) / np.sqrt(2 * np.pi), color="black", linewidth=1, label="normal")
    histogram.set(xlabel="residual / its sigma (beyond 5 in the last bar)", ylabel="frequency")
    histogram.legend(fontsize=8, loc="upper right")
    distance = np.linalg.norm(ray, axis=1)
    direction = ray / np.maximum(distance, 1e-9)[:, None]
    along = (v * direction).sum(axis=1)
    across = v[:, 1] * direction[:, 0] - v[:, 0] * direction[:, 1]
    edges = np.linspace(0, distance.max() * (1 + 1e-9), 13)
    ring = np.clip(np.digitize(distance, edges) - 1, 0, 11)
    middle = (edges[1:] + edges[:-1]) / 2
    for values, colour, label in ((along, RED, "radial"), (across, BLUE, "tangential")):
        count = np.bincount(ring, minlength=12).astype(float)
        count[count == 0] = np.nan  # in an empty ring
        mean = np.bincount(ring, weights=values, minlength=12) / count
        rms = np.sqrt(np.bincount(ring, weights=values**2, minlength=12) / count)
        radial.plot(middle, rms, "-o", color=colour, markersize=3, label=f"{label} RMS")
        radial.plot(middle, mean, "--", color=colour, linewidth=1, label=f"{label} mean")
    radial.axhline(0, color="black", linewidth=0.5)
    radial.set(xlabel="distance from the centre of the photograph [px]", ylabel="residual [px]")
    lowest, highest = radial.get_ylim()
    radial.set_ylim(lowest, highest + 0.25 * (highest - lowest))  # room for the legend
    radial.legend(fontsize=8, loc="upper left", ncols=2)  # "best" takes seconds with many points
    return figure


def photograph_figure(shown: PlotData) -> Figure:
    """Draw RMS residual and number of points of each photograph."""
    rms, count = shown.image_rms_px, shown.image_points
    m = len(rms)
    labels = [_plain(_short(name)) for name in shown.images] if m <= MAX_NAMED else []
    names_in = LETTER_IN * max(map(len, labels), default=0)
    figure = two_panel_figure(3.4 + max(0.0, names_in - 0.7), bottom_in=max(BOTTOM_IN, 0.2 + names_in))
    bars, numbers = figure.subplots(1, 2)
    x = np.arange(m)
    for panel, values, colour, label in (
        (bars, rms, BLUE, "RMS residual per coordinate [px]"),
        (numbers, count, GREEN, "accepted image points"),
    ):
        panel.bar(x, np.nan_to_num(values), color=colour)
        panel.set_ylabel(label)
        if labels:
            panel.set_xticks(x, labels, rotation=90, fontsize=7)
        else:
            panel.set_xlabel("photograph, in order")
    bars.axhline(shown.rms_px, color="black", linewidth=1, linestyle="--")
    return figure


def plan_axes(
    points: FloatArray, position: FloatArray | None = None
) -> tuple[FloatArray, tuple[str, str, str]]:
    """Return axes that show the object best from the side of the cameras, and their names.

    Args:
        points: object points, shape (n, 3).
        position: projection centres, shape (m, 3); without them the third axis may point either way.

    Returns:
        Rotation from object axes, shape (3, 3), and the names of the three axes. The rotation is the identity
        if the object is nearly level and below the cameras. It is a half turn about X if the object is nearly
        level and above them. Otherwise its rows are the principal axes of the object.
    """
    centre = points.mean(axis=0)
    towards = np.zeros(3) if position is None or not len(position) else position.mean(axis=0) - centre
    _, _, Vt = np.linalg.svd(points - centre, full_matrices=False)
    if len(Vt) < 3 or abs(Vt[2, 2]) > FLAT_COSINE:
        if towards[2] < 0:
            return np.diag([1.0, -1.0, -1.0]), ("X", "-Y", "-Z")
        return np.eye(3), ("X", "Y", "Z")
    if Vt[2] @ towards < 0:
        Vt[2] *= -1
    Vt[1] *= np.sign(np.linalg.det(Vt))
    return Vt, ("along", "across", "up from the main plane")


def _arrows(panel: Axes, xy: FloatArray, v: FloatArray, colour: str) -> None:
    panel.quiver(*xy.T, *v.T, color=colour, angles="xy", scale_units="xy", scale=1, width=0.0015, headwidth=4)


def _typical(v: FloatArray) -> float:
    """Return the root mean square length of vectors, 0 for none."""
    return float(np.sqrt((v**2).sum(axis=1).mean())) if len(v) else 0.0


def _round_factor(factor: float) -> float:
    """Return the largest of 1, 2, 5 x 10^n that does not exceed the factor, at least 1."""
    if not np.isfinite(factor) or factor <= 1:
        return 1.0
    power = 10.0 ** np.floor(np.log10(factor))
    return float(max(step * power for step in (1, 2, 5) if step * power <= factor))


def _short(name: str) -> str:
    """Return a file name without folder and suffix, shortened from the left."""
    return _clipped(name.rsplit("/", 1)[-1].rsplit(".", 1)[0])


def _clipped(name: str) -> str:
    """Return a name, or only its end if it is long."""
    return name if len(name) <= 16 else "..." + name[-13:]


def _plain(text: str) -> str:
    """Return text that matplotlib draws literally: no mathematics, no characters missing in its font."""
    powers = SUPERSCRIPTS.values()  # of ten, in units
    drawn = (c.isprintable() and (ord(c) < 0x250 or ord(c) in powers) for c in text)
    shown = "".join(c if on else "?" for c, on in zip(text, drawn, strict=True))
    return shown.replace("$", r"\$")
