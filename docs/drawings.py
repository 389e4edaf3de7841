"""Drawings on the page of conventions: frames, rotations and directions of distortion, as SVG in the page.

The program computes the drawings where possible: `sfm.model.camera.project` gives the image point of the
pinhole camera, `sfm.model.conventions.rotation_from_angles` rotates the axes, and the distortion models give
the vectors. Drawings use the colours of the page, so they are readable on a light and on a dark background.
"""

from __future__ import annotations

from collections.abc import Callable
from html import escape
from typing import Any

import numpy as np
from docutils import nodes
from sphinx.application import Sphinx
from sphinx.util.docutils import SphinxDirective

from sfm.model.camera import camera_from_values, pixel_from_tangents, tangents_from_pixel
from sfm.model.conventions import FloatArray, image_from_pixel, pixel_from_image, rotation_from_angles
from sfm.targets.codes.plates import PlateFamily

ARROW = 9.0  # length of an arrow head, in the unit of the drawing


class Drawing:
    """Lines, dots and labels on a sheet, with x to the right and y down."""

    def __init__(self, width: float, height: float, what: str) -> None:
        self.size = (width, height)
        self.what = what
        self.parts: list[str] = []

    def line(self, a: FloatArray, b: FloatArray, kind: str = "ink", *, dashed: bool = False) -> None:
        """Draw a line from a to b."""
        dash = ' stroke-dasharray="4 4"' if dashed else ""
        self.parts.append(
            f'<line class="{kind}" x1="{a[0]:.1f}" y1="{a[1]:.1f}" x2="{b[0]:.1f}" y2="{b[1]:.1f}"{dash}/>'
        )

    def arrow(
        self, a: FloatArray, b: FloatArray, kind: str = "ink", name: str = "", *, head: float = ARROW
    ) -> None:
        """Draw an arrow from a to b, with its name next to the head."""
        a, b = np.asarray(a, dtype=float), np.asarray(b, dtype=float)
        along = (b - a) / np.linalg.norm(b - a)
        across = np.array([-along[1], along[0]])
        self.line(a, b - 0.8 * head * along, kind)
        corners = [b, b - head * along + 0.38 * head * across, b - head * along - 0.38 * head * across]
        self.area(np.array(corners), f"{kind} full")
        if name:
            self.words(
                b + (8.0 + 3.5 * len(name) * abs(along[0]) + 4.0 * abs(along[1])) * along,
                name,
                kind,
                middle=True,
            )

    def area(self, corners: FloatArray, kind: str) -> None:
        """Draw a closed polygon."""
        text = " ".join(f"{x:.1f},{y:.1f}" for x, y in corners)
        self.parts.append(f'<polygon class="{kind}" points="{text}"/>')

    def curve(self, points: FloatArray, kind: str = "ink") -> None:
        """Draw a polyline."""
        text = " ".join(f"{x:.1f},{y:.1f}" for x, y in points)
        self.parts.append(f'<polyline class="{kind} open" points="{text}"/>')

    def dot(self, at: FloatArray, kind: str = "ink", radius: float = 4.0) -> None:
        """Draw a dot."""
        self.parts.append(f'<circle class="{kind} full" cx="{at[0]:.1f}" cy="{at[1]:.1f}" r="{radius}"/>')

    def words(self, at: FloatArray, text: str, kind: str = "ink", *, middle: bool = False) -> None:
        """Write a label that starts at a position or is centred there."""
        anchor = ' text-anchor="middle" dominant-baseline="central"' if middle else ""
        self.parts.append(
            f'<text class="{kind}" x="{at[0]:.1f}" y="{at[1]:.1f}"{anchor}>{escape(text)}</text>'
        )

    def svg(self) -> str:
        """Return the drawing for a page."""
        width, height = self.size
        return (
            f'<svg class="drawing" viewBox="0 0 {width:g} {height:g}" style="max-width: {width:g}px" '
            f'role="img" aria-label="{escape(self.what, quote=True)}">{"".join(self.parts)}</svg>'
        )


def moved(place: FloatArray, *by: float) -> FloatArray:
    """Return a position shifted along the axes."""
    return np.asarray(place) + np.array(by)


def frames() -> Drawing:
    """Draw the pixel frame, COLMAP's pixel frame and the image frame on a photograph of 8 x 5 pixels."""
    sheet = Drawing(720, 385, "Pixel frame, image frame and the pixel origin of COLMAP on a small photograph")
    size, pixel, side = (8, 5), np.array([1.0, 1.0]), 60.0
    first = np.array([110.0, 80.0])  # centre of the top-left pixel on the sheet

    def at(xy_px: tuple[float, float]) -> FloatArray:
        return first + side * np.asarray(xy_px)

    for column in range(size[0] + 1):
        sheet.line(at((column - 0.5, -0.5)), at((column - 0.5, size[1] - 0.5)), "muted")
    for row in range(size[1] + 1):
        sheet.line(at((-0.5, row - 0.5)), at((size[0] - 0.5, row - 0.5)), "muted")
    sheet.arrow(at((0, 0)), at((2.0, 0)), "first", "x px")
    sheet.arrow(at((0, 0)), at((0, 2.0)), "first", "y px")
    sheet.dot(at((0, 0)), "first")
    sheet.dot(at((-0.5, -0.5)), "second")
    sheet.words(at((-0.5, -0.62)), "COLMAP, Metashape, PhotoModeler: (0, 0) here, (0.5, 0.5) there", "second")
    sheet.words(at((0.12, 0.36)), "(0, 0)", "first")
    centre = pixel_from_image(np.zeros(2), size, pixel)
    x_axis, y_axis = (pixel_from_image(np.array(axis), size, pixel) for axis in ((2.6, 0.0), (0.0, 1.9)))
    sheet.arrow(at(centre), at(x_axis), "third", "x mm")
    sheet.arrow(at(centre), at(y_axis), "third", "y mm")
    sheet.dot(at(centre), "third")
    sheet.words(at(moved(centre, -1.55, 0.3)), "centre of the sensor", "third")
    principal = pixel_from_image(np.array([1.15, -0.75]), size, pixel)
    sheet.dot(at(principal), "ink")
    sheet.line(at(centre), at((principal[0], centre[1])), "ink", dashed=True)
    sheet.line(at((principal[0], centre[1])), at(principal), "ink", dashed=True)
    sheet.words(at(moved(principal, 0.12, 0.3)), "principal point (x0, y0)", "ink")
    return sheet


def pinhole() -> Drawing:
    """Draw the camera, its image plane, a ray and the object frame, seen from the side."""
    sheet = Drawing(720, 235, "Object frame, camera axes and the ray through an image point")
    eye = camera_from_values("sheet", "brown", (720, 430), (0.01, 0.01), c_mm=9.0)
    view = rotation_from_angles(*np.deg2rad([66.0, 0.0, 0.0])) @ np.eye(3)
    turn = rotation_from_angles(0.0, 0.0, np.deg2rad(-32.0))
    stand = turn.T @ np.array([0.4, -11.6, 5.8])

    def at(xyz: FloatArray) -> FloatArray:
        UVW = (np.asarray(xyz, dtype=float) - stand) @ (turn.T @ view)
        return pixel_from_tangents(eye, (-UVW[:2] / UVW[2])[None])[0] + (80.0, -98.0)

    for axis, name in zip(np.eye(3), "XYZ", strict=True):
        sheet.arrow(at(np.zeros(3)), at(1.6 * axis), "ink", name)
    point = np.array([2.5, 1.6, 0.3])
    station = np.array([-1.6, -3.0, 1.3])
    looks = moved(point, -0.9, 0.9, 0.1) - station
    back = -looks / np.linalg.norm(looks)
    right = np.cross([0.0, 0.0, 1.0], back)
    right /= np.linalg.norm(right)
    R = np.column_stack([right, np.cross(back, right), back])
    c = 1.7
    corners = [
        station + R @ np.array([x, y, -c]) for x, y in ((-0.9, -0.6), (0.9, -0.6), (0.9, 0.6), (-0.9, 0.6))
    ]
    sheet.area(np.array([at(corner) for corner in corners]), "muted full faint")
    for corner in corners:
        sheet.line(at(station), at(corner), "muted")
    U = R.T @ (point - station)
    image = station + R @ (-U / U[2] * c)
    sheet.line(at(station), at(point), "second", dashed=True)
    for axis, name in zip(R.T, ("U (x)", "V (y)", "W (back)"), strict=True):
        sheet.arrow(at(station), at(station + 1.15 * axis), "first", name)
    sheet.dot(at(station), "first")
    sheet.words(moved(at(station), -34.0, -10.0), "X0", "first")
    sheet.dot(at(image), "second")
    sheet.words(moved(at(image), -20.0, 44.0), "image point (c u, c v)", "second")
    sheet.dot(at(point), "second", 5.0)
    sheet.words(moved(at(point), 10.0, 5.0), "X", "second")
    middle = station + R @ np.array([0.0, 0.0, -c])
    sheet.line(at(station), at(middle), "first", dashed=True)
    sheet.words(moved(at(station + R @ np.array([0.0, 0.0, -c / 2])), 0.0, -8.0), "c", "first")
    return sheet


def rotations() -> Drawing:
    """Draw omega, phi and kappa, each of which rotates the axes that the previous angle has rotated."""
    sheet = Drawing(720, 260, "Rotations omega about x, phi about the turned y, kappa about the turned z")
    view = np.array([[-0.62, 0.78, 0.0], [0.36, 0.29, -0.88]])  # from the front, x towards the reader
    steps = ((0.42, 0.0, 0.0), (0.42, 0.42, 0.0), (0.42, 0.42, 0.5))
    before = np.eye(3)
    names = (("omega", "about x"), ("phi", "about y'"), ("kappa", "about z''"))
    for number, (angles, (name, about)) in enumerate(zip(steps, names, strict=True)):
        origin = np.array([125.0 + 235.0 * number, 135.0])

        def at(xyz: FloatArray, origin: FloatArray = origin) -> FloatArray:
            return origin + 88.0 * (view @ xyz)

        R = rotation_from_angles(*angles)
        turned = "'" * (number + 1)
        for axis in range(3):
            if axis != number:
                sheet.arrow(origin, at(before[:, axis]), "muted", "xyz"[axis] + "'" * number)
            sheet.arrow(origin, at(R[:, axis]), "first", "xyz"[axis] + turned)
        start = before[:, (number + 1) % 3]
        end = R[:, (number + 1) % 3]
        between = np.array(
            [at(0.7 * direction / np.linalg.norm(direction)) for direction in np.linspace(start, end, 12)]
        )
        sheet.curve(between[:-1], "second")
        sheet.arrow(between[-3], between[-1], "second")
        sheet.words(moved(origin, 0.0, 112.0), f"{name}, {about}", "second", middle=True)
        before = R
    return sheet


def distortions() -> Drawing:
    """Draw the point that enters the formula: the measured point in `brown`, the ideal in `brown_forward`."""
    sheet = Drawing(720, 300, "brown corrects the measured point, brown_forward distorts the ideal one")
    size, pixel = (600, 400), (0.06, 0.06)
    lens = (("K1", 5e-4),)
    for number, model in enumerate(("brown", "brown_forward")):
        camera = camera_from_values(model, model, size, pixel, c_mm=28.0, values=lens)
        origin = np.array([185.0 + 350.0 * number, 130.0])

        def at(xy_mm: FloatArray, origin: FloatArray = origin) -> FloatArray:
            return origin + 9.0 * np.asarray(xy_mm) * (1.0, -1.0)

        box = np.array([[-18.0, -12.0], [18.0, -12.0], [18.0, 12.0], [-18.0, 12.0]])
        sheet.area(np.array([at(corner) for corner in box]), "muted open")
        grid = np.array([[x, y] for y in (-9.0, -3.0, 3.0, 9.0) for x in (-14.0, -8.4, -2.8, 2.8, 8.4, 14.0)])
        grid *= 0.95
        if model == "brown":
            ideal = 28.0 * tangents_from_pixel(camera, pixel_from_image(grid, size, np.array(pixel)))
            tails, heads = grid, ideal
        else:
            heads = image_from_pixel(pixel_from_tangents(camera, grid / 28.0), size, np.array(pixel))
            tails = grid
        for tail, head in zip(tails, heads, strict=True):
            sheet.dot(at(tail), "first" if model == "brown" else "second", 2.5)
            if np.linalg.norm(head - tail) > 0.3:
                sheet.arrow(at(tail), at(head), "ink", head=5.0)
        kind_of_lens = "barrel" if model == "brown" else "pincushion"
        words = ("measured", "ideal") if model == "brown" else ("ideal", "measured")
        sheet.words(moved(origin, 0.0, 130.0), f"{model}, K1 > 0: a {kind_of_lens} lens", "ink", middle=True)
        kind = "first" if model == "brown" else "second"
        sheet.words(moved(origin, 0.0, 152.0), f"dot: {words[0]}, arrow head: {words[1]}", kind, middle=True)
    return sheet


def axes_of_others() -> Drawing:
    """Draw the camera axes of this program and those of computer vision."""
    sheet = Drawing(720, 220, "Camera axes: y up and z backwards here, y down and z forwards in COLMAP")
    view = np.array([[0.92, 0.0, -0.45], [-0.18, -0.95, -0.38]])  # of (right, up, back)
    sets = (
        ("Kolinear, PhotoModeler, AICON, DBAT", np.eye(3), "first"),
        ("COLMAP, OpenCV, Metashape", np.diag([1.0, -1.0, -1.0]), "second"),
    )
    for number, (who, axes, kind) in enumerate(sets):
        origin = np.array([175.0 + 360.0 * number, 95.0])
        face = [
            origin + 70.0 * (view @ np.array([x, y, -0.75]))
            for x, y in ((-1, -0.7), (1, -0.7), (1, 0.7), (-1, 0.7))
        ]
        sheet.area(np.array(face), "muted full faint")
        for corner in face:
            sheet.line(origin, corner, "muted")
        for axis, name in zip(axes, "xyz", strict=True):
            sheet.arrow(origin, origin + 72.0 * (view @ axis), kind, name)
        sheet.words(moved(origin, 0.0, 108.0), who, kind, middle=True)
    return sheet


def plates() -> Drawing:
    """Draw row 0 and point numbers of a plate with marks, also rotated, of shifted rows, and of a board."""
    sheet = Drawing(
        720,
        640,
        "Row 0, columns and numbers of points of a plate with marks, also turned, and of a checkerboard",
    )
    marked = PlateFamily("grid", 5, 6, ((1, 1), (1, 4), (3, 2)))
    shifted = PlateFamily("asymmetric-grid", 5, 5)
    board = PlateFamily("checkerboard", 4, 5)
    turn = np.deg2rad(150.0)
    turned = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
    for plate, number, pitch, rotation, caption in (
        (marked, 0, 38.0, np.eye(2), "grid of 5 x 6 with marks, as printed"),
        (marked, 1, 38.0, turned, "the same, turned by 150 degrees"),
        (shifted, 2, 44.0, np.eye(2), "asymmetric grid of 5 x 5"),
        (board, 3, 36.0, np.eye(2), "checkerboard of 4 x 5 crossings"),
    ):
        middle = np.array([190.0 + 355.0 * (number % 2), 150.0 + 310.0 * (number // 2)])
        xy = plate.plane(pitch)[:, :2]
        centre = (xy.min(axis=0) + xy.max(axis=0)) / 2

        def at(
            place: FloatArray,
            middle: FloatArray = middle,
            rotation: FloatArray = rotation,
            centre: FloatArray = centre,
        ) -> FloatArray:
            return middle + (rotation @ (np.asarray(place) - centre)) * (1.0, -1.0)

        if plate.name == "checkerboard":
            for row in range(plate.rows + 1):
                for column in range(plate.columns + 1):
                    left, top = pitch * (column - 1), -pitch * (row - 1)
                    corners = (
                        (left, top),
                        (left + pitch, top),
                        (left + pitch, top - pitch),
                        (left, top - pitch),
                    )
                    dark = (row + column) % 2 == 0
                    kind = "muted full faint" if dark else "muted open"
                    sheet.area(np.array([at(np.array(corner)) for corner in corners]), kind)
        for k, place in enumerate(xy):
            row, column = divmod(k, plate.columns)
            is_mark = (row, column) in plate.marks
            sheet.dot(
                at(place), "second" if is_mark else "first" if row == 0 else "ink", 8.0 if is_mark else 4.5
            )
            if row == 0 or column == 0 or is_mark:
                sheet.words(moved(at(place), 0.0, -15.0), str(k), "second" if is_mark else "ink", middle=True)
        left = -2.1 * pitch if plate.name == "checkerboard" else -1.3 * pitch
        for row in (0, 1):
            beside = np.array([left, xy[row * plate.columns, 1]])
            sheet.words(at(beside), f"row {row}", "ink" if row else "first", middle=True)
        sheet.words(moved(middle, 0.0, 160.0), caption, "ink", middle=True)
    return sheet


DRAWINGS: dict[str, Callable[[], Drawing]] = {
    "frames": frames,
    "pinhole": pinhole,
    "rotations": rotations,
    "distortions": distortions,
    "axes-of-others": axes_of_others,
    "plates": plates,
}


class DrawingDirective(SphinxDirective):
    """Directive that inserts one of the drawings."""

    required_arguments = 1

    def run(self) -> list[nodes.Node]:
        """Return the node of the drawing."""
        return [nodes.raw("", DRAWINGS[self.arguments[0]]().svg(), format="html")]


def setup(sphinx: Sphinx) -> dict[str, Any]:
    """Add the directive."""
    sphinx.add_directive("drawing", DrawingDirective)
    return {"parallel_read_safe": True}
