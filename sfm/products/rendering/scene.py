"""Scene: plane faces in space with circular targets and other marks, which `render` photographs.

Each face is a rectangle with plane axes a (right) and b (up), as seen from outside. Everything painted on it
is given in these plane coordinates. Intensities are reflectances between 0 and 1.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sfm.model.conventions import FloatArray, IntArray
from sfm.model.errors import GeometryError
from sfm.targets.codes.concentric import ConcentricFamily
from sfm.targets.codes.rings import CodeFamily
from sfm.targets.codes.tags import TagFamily, tag_modules

DISC, ARC, RECTANGLE = 0, 1, 2
UNCODED = -1
# Gap between the arcs around a dot, as measured on the camcal sheet, rad.
ARC_GAP = np.radians(44.0)
MAX_ARCS = int(2 * np.pi / (2 * ARC_GAP))  # of a ring: arcs must be at least as long as the gaps


@dataclass(frozen=True)
class Faces:
    """Plane rectangles in space, visible from the side to which a x b points."""

    centre: FloatArray  # object unit, (f, 3)
    axes: FloatArray  # unit vectors a and b of the plane, (f, 2, 3)
    half: FloatArray  # half lengths along a and b, object unit, (f, 2)
    value: FloatArray  # reflectance, (f,)
    texture: FloatArray  # amplitude of the texture, fraction of the reflectance, (f,)
    grain: FloatArray  # size of a grain of the texture, object unit, (f,)

    def normals(self) -> FloatArray:
        """Return the outward normals, (f, 3)."""
        return np.cross(self.axes[:, 0], self.axes[:, 1])

    def place(self, face: IntArray, xy: FloatArray) -> FloatArray:
        """Return the object coordinates of plane coordinates on the given faces, (k, 3)."""
        return np.asarray(self.centre[face] + np.einsum("ki,kij->kj", xy, self.axes[face]))

    def corners(self) -> FloatArray:
        """Return the corners of each face, (f, 4, 3)."""
        sign = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]])
        return np.asarray(self.centre[:, None] + np.einsum("fi,ci,fij->fcj", self.half, sign, self.axes))


@dataclass(frozen=True)
class Marks:
    """Marks painted on the faces, later ones over earlier ones."""

    face: IntArray  # (k,)
    kind: IntArray  # DISC, ARC or RECTANGLE, (k,)
    centre: FloatArray  # plane coordinates, object unit, (k, 2)
    shape: FloatArray  # disc: radius; arc: inner, outer radius, start and length (rad, counter-clockwise);
    # rectangle: half lengths and rotation (rad); 0 elsewhere; object unit, (k, 4)
    value: FloatArray  # reflectance, (k,)

    def __len__(self) -> int:
        return len(self.face)


@dataclass(frozen=True)
class CircularTargets:
    """The circular targets among the marks; their positions are the truth of a survey."""

    face: IntArray  # (n,)
    centre: FloatArray  # plane coordinates, object unit, (n, 2)
    radius: FloatArray  # of the dot, object unit, (n,)
    code: IntArray  # UNCODED without a ring, (n,)

    def __len__(self) -> int:
        return len(self.face)


@dataclass(frozen=True)
class Light:
    """A lamp and ambient light."""

    position: FloatArray  # object unit, (3,)
    reach: float  # distance at which the lamp gives strength 1 on a face at right angles, object unit
    ambient: float  # light from all directions


@dataclass(frozen=True)
class Optics:
    """Effects of lens and sensor on the light."""

    blur_px: float = 0.7  # standard deviation of the point spread, px
    vignetting: float = 0.0  # fraction of the light lost in the corners
    exposure: float = 0.9  # fraction of the full scale for light of strength 1
    noise: float = 0.0  # standard deviation in the dark, fraction of the full scale
    shot_noise: float = 0.0  # additional standard deviation at full scale, fraction of the full scale
    bits: int = 8  # 8 or 16
    oversampling: int = 2  # cells along a pixel; a cell knows how much light falls on it but not where in it,
    # which at 2 and a blur of 0.7 px costs 0.3 % of the step of an edge and 0.0015 px in the centre of a dot


@dataclass(frozen=True)
class Scene:
    """Everything in front of the camera."""

    faces: Faces
    marks: Marks
    targets: CircularTargets
    light: Light | None = None  # None = the same light of strength 1 everywhere
    background: float = 0.05  # intensity where there is no face


def join_marks(parts: list[Marks]) -> Marks:
    """Return all marks in the order given."""
    if not parts:
        none = np.zeros(0, dtype=np.int64)
        return Marks(none, none, np.zeros((0, 2)), np.zeros((0, 4)), np.zeros(0))
    return Marks(
        np.concatenate([p.face for p in parts]),
        np.concatenate([p.kind for p in parts]),
        np.concatenate([p.centre for p in parts]),
        np.concatenate([p.shape for p in parts]),
        np.concatenate([p.value for p in parts]),
    )


def discs(face: int, centre: FloatArray, radius: float, value: float) -> Marks:
    """Return round dots of one size on one face, centres (k, 2)."""
    k = len(centre)
    shape = np.zeros((k, 4))
    shape[:, 0] = radius
    return Marks(np.full(k, face), np.full(k, DISC), np.asarray(centre, float), shape, np.full(k, value))


def rectangles(face: int, centre: FloatArray, half: FloatArray, turn: FloatArray, value: FloatArray) -> Marks:
    """Return rectangles on one face: centres (k, 2), half lengths (k, 2), rotation, rad (k,), values (k,)."""
    k = len(centre)
    shape = np.column_stack([half, turn, np.zeros(k)])
    return Marks(np.full(k, face), np.full(k, RECTANGLE), np.asarray(centre, float), shape, value)


def coded_ring(
    face: int,
    centre: FloatArray,
    radius: float,
    number: int,
    family: CodeFamily,
    value: float,
    *,
    turn: float = 0.0,
) -> Marks:
    """Return the dot and the ring of one coded target.

    Args:
        face: index of the face.
        centre: plane coordinates, (2,), object unit.
        radius: radius of the dot, object unit.
        number: code number; for `arcs` the number of arcs.
        family: the family of codes.
        value: reflectance of dot and ring.
        turn: direction of the first cell, counter-clockwise from a, rad.

    Returns:
        A disc and one arc for each run of set cells.

    Raises:
        GeometryError: the family has no such number.
    """
    ends = _runs(number, family)
    k = len(ends)
    shape = np.zeros((k, 4))
    shape[:, 0], shape[:, 1] = family.inner * radius, family.outer * radius
    # Codes run clockwise in the photograph, angles on the face counter-clockwise.
    shape[:, 2], shape[:, 3] = turn - ends.sum(axis=1), ends[:, 1]
    at = np.tile(np.asarray(centre, float), (k, 1))
    ring = Marks(np.full(k, face), np.full(k, ARC), at, shape, np.full(k, value))
    return join_marks([discs(face, at[:1], radius, value), ring])


def concentric_rings(
    face: int, centre: FloatArray, radius: float, number: int, family: ConcentricFamily, value: float
) -> Marks:
    """Return the rings of one concentric tag.

    Args:
        face: index of the face.
        centre: plane coordinates, (2,), object unit.
        radius: radius of the outer edge, object unit.
        number: id of the tag.
        family: the family of tags.
        value: reflectance of the rings.

    Returns:
        An arc of a full turn for each ring.

    Raises:
        GeometryError: the family has no such tag.
    """
    edges = radius * family.radii(number).reshape(-1, 2)
    k = len(edges)
    shape = np.column_stack([edges[:, 1], edges[:, 0], np.zeros(k), np.full(k, 2 * np.pi)])
    at = np.tile(np.asarray(centre, float), (k, 1))
    return Marks(np.full(k, face), np.full(k, ARC), at, shape, np.full(k, value))


def square_tag(
    face: int,
    centre: FloatArray,
    half: float,
    number: int,
    family: TagFamily,
    value: float,
    paper: float,
    *,
    turn: float = 0.0,
) -> Marks:
    """Return the black square of a tag and the white modules of its code.

    Args:
        face: index of the face.
        centre: plane coordinates, (2,), object unit.
        half: half the side of the black square, object unit.
        number: id of the tag.
        family: the family of tags.
        value: reflectance of the border and of black modules.
        paper: reflectance of white modules.
        turn: direction of the upper side, counter-clockwise from a, rad.

    Returns:
        A rectangle for the square, and one for each run of white modules along a row or a column. The joint
        of two runs is covered by one that crosses them.

    Raises:
        GeometryError: the family has no such tag.
    """
    white = ~tag_modules(family, number)
    module = 2 * half / family.modules
    at, size = [np.zeros(2)], [np.array([half, half])]
    for rows, across in ((white, False), (white.T, True)):
        for i, row in enumerate(rows):
            steps = np.flatnonzero(np.diff(np.concatenate([[0], row.astype(np.int8), [0]])))
            for first, last in steps.reshape(-1, 2):
                middle, length = np.array([(first + last) / 2, i + 0.5]), np.array([last - first, 1]) / 2
                x, y = middle[::-1] if across else middle
                at.append(np.array([x * module - half, half - y * module]))
                size.append(module * (length[::-1] if across else length))
    cos, sin = np.cos(turn), np.sin(turn)
    centres = np.array(at) @ np.array([[cos, sin], [-sin, cos]]) + centre
    k = len(centres)
    reflectance = np.concatenate([[value], np.full(k - 1, paper)])
    return rectangles(face, centres, np.array(size), np.full(k, turn), reflectance)


def _runs(number: int, family: CodeFamily) -> FloatArray:
    """Return start and length (rad, clockwise) of each run of set cells, (k, 2)."""
    if family.cells == 0:
        if not 1 <= number <= MAX_ARCS:
            raise GeometryError(f"code {number}: a ring of arcs has 1 to {MAX_ARCS}")
        start = 2 * np.pi * np.arange(number) / number
        return np.column_stack([start, np.full(number, 2 * np.pi / number - ARC_GAP)])
    entry = np.flatnonzero(family.number == number)
    if len(entry) == 0:
        raise GeometryError(f"code {number}: family {family.name} has 1 to {family.number.max()}")
    pattern = int(family.pattern[entry[0]])
    cell = 2 * np.pi / family.cells
    bits = np.array([(pattern >> (family.cells - 1 - i)) & 1 for i in range(family.cells)])
    first = np.flatnonzero((bits == 1) & (np.roll(bits, 1) == 0))
    length = [int(np.argmin(np.roll(bits, -i))) for i in first]
    return np.column_stack([first, length]) * cell
