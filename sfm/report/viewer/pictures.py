"""Content of the viewer of a page: the scene as parallel arrays, and pictures within a size budget.

Thumbnails have priority, then photographs, then crops, with the largest residuals first. Files beside the
page contain what does not fit in it: every photograph, and its crops as the cells of one picture.
"""

from __future__ import annotations

import base64
from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path

import cv2
import numpy as np

from sfm.model.camera import Camera
from sfm.model.conventions import AnyArray, BoolArray, FloatArray, IntArray
from sfm.model.errors import PhotographError
from sfm.photographs.reading import read_photograph
from sfm.report.figures.overlays import fitted_picture, jpeg_of, overlay_names
from sfm.runtime.progress import SILENT, Progress

BUDGET_MB = 15.0
"""maximum size of the pictures of a page, 10^6 bytes of base64 text"""
THUMBNAIL_PX = 160
VIEW_PX = 1400  # longer side of an embedded photograph
FILE_PX = 2400  # longer side of a photograph beside the page
CROP_PX = 64  # side of a stored crop; larger ones are averaged
COLUMNS = 32  # columns of cells in a file of crops
CROP_DIAMETERS = 2.2  # side of a crop over the target's larger diameter
MIN_SIDE_PX, MAX_SIDE_PX = 20, 240  # of a crop in the photograph
SIDE_PX = 40  # of a crop around a point without an outline
THUMBNAIL_QUALITY, VIEW_QUALITY, FILE_QUALITY, CROP_QUALITY = 70, 75, 85, 78
MAX_CROP_BYTES = 4500  # of a stored crop of a noisy photograph
THUMBNAILS_PART = 0.3  # maximum part of the budget
VIEWS_PART = 0.6  # of the budget left by the thumbnails


@dataclass(frozen=True)
class Pictures:
    """Pictures inside a page, and the names of those in files beside it."""

    base64: str = ""  # all embedded pictures, one after another
    count: int = 0  # photographs that were read
    files: tuple[str, ...] = ()  # file of each photograph beside the page, "" for none, (m,)
    crop_files: tuple[str, ...] = ()  # file with the crops of each photograph, likewise
    beside: Mapping[str, bytes] = field(default_factory=dict)  # content of these files by name
    thumbnail: IntArray = field(
        default_factory=lambda: np.zeros((0, 2), np.int64)
    )  # start and length, (m, 2)
    view: IntArray = field(default_factory=lambda: np.zeros((0, 2), np.int64))  # likewise
    ray: IntArray = field(default_factory=lambda: np.zeros(0, np.int64))  # image point of each crop, (c,)
    frame: FloatArray = field(default_factory=lambda: np.zeros((0, 4)))  # left and top edge, side, px of the
    # photograph, and side of the stored crop, px, (c, 4)
    crop: IntArray = field(default_factory=lambda: _none(0))  # start and length, (c, 2)
    cell: IntArray = field(default_factory=lambda: np.zeros(0, np.int64))  # cell in the file of crops, (c,)
    notes: tuple[str, ...] = ()  # what the page omits

    def arrays(self) -> dict[str, tuple[str, AnyArray]]:
        """Return the arrays to pack; starts and lengths count groups of four base64 characters."""
        return {
            **{
                f"{name}.{part}": ("u4", values[:, k])
                for name, values in (("thumbnail", self.thumbnail), ("view", self.view), ("crop", self.crop))
                for k, part in enumerate(("start", "length"))
            },
            "crop.ray": ("u4", self.ray),
            "crop.frame": ("f4", self.frame),
            "crop.cell": ("u4", self.cell),
        }


@dataclass(frozen=True)
class _Cut:
    """Pictures cut out of one photograph."""

    thumbnail: bytes
    view: bytes
    file: bytes
    crops: dict[int, bytes]  # by ray
    frames: dict[int, tuple[float, float, float, int]]  # see Pictures.frame
    cells: bytes


def cut_pictures(
    scene: ViewerScene,
    paths: Mapping[str, Path],
    *,
    budget_mb: float = BUDGET_MB,
    beside: str = "",
    jobs: int = 1,
    progress: Progress = SILENT,
) -> Pictures:
    """Cut thumbnails, photographs and crops of a scene out of its photographs.

    Args:
        scene: scene of the viewer.
        paths: files of the photographs by name; files that can no longer be read are left out.
        budget_mb: maximum size of the embedded pictures, 10^6 bytes of the page.
        beside: folder of the files beside the page, as the page names it; "" if there are none.
        jobs: photographs processed at the same time.
        progress: called for every photograph.
    """
    m, rays = len(scene.photographs), scene.rays
    if not any(name in paths for name in scene.photographs):
        return Pictures(files=("",) * m, crop_files=("",) * m, thumbnail=_none(m), view=_none(m))
    order = rays.worst_first()
    budget = int(budget_mb * 1e6 / 4 * 3)
    scarce = len(rays) * MAX_CROP_BYTES > 0.3 * budget
    wanted = np.zeros(len(rays), dtype=bool)
    wanted[order[: budget // 500] if scarce else order] = True
    rows_of = np.split(
        np.argsort(rays.photo, kind="stable"), np.cumsum(np.bincount(rays.photo, minlength=m))[:-1]
    )

    def cut(i: int) -> _Cut | None:
        path = paths.get(scene.photographs[i])
        if path is None:
            return None
        try:
            grey = read_photograph(path)
        except PhotographError:
            return None
        grey = (grey >> 8).astype(np.uint8) if grey.dtype == np.uint16 else grey
        width_px = scene.cameras[scene.camera[i]].size_px[0]
        return _cut(grey, width_px, scene, rows_of[i], wanted, with_files=bool(beside), with_cells=scarce)

    cuts: list[_Cut | None] = []
    with ThreadPoolExecutor(max_workers=max(1, jobs)) as pool:
        for name, cut_out in zip(scene.photographs, pool.map(cut, range(m)), strict=True):
            cuts.append(cut_out)
            progress.advance(name)
    return _embed(scene, cuts, order, budget, beside)


def _cut(
    grey: AnyArray,
    width_px: int,
    scene: ViewerScene,
    rows: IntArray,
    wanted: AnyArray,
    *,
    with_files: bool,
    with_cells: bool,
) -> _Cut:
    crops: dict[int, bytes] = {}
    frames: dict[int, tuple[float, float, float, int]] = {}
    cells = []
    scale = grey.shape[1] / width_px  # below 1 if a smaller picture replaces the photograph
    # first column, first row and side of the crops of rays, px, inside the picture
    semi = scene.rays.ellipse[rows, 0]
    across = np.where(np.isfinite(semi), 2 * semi * CROP_DIAMETERS, SIDE_PX)
    sides = np.minimum(np.rint(scale * np.clip(across, MIN_SIDE_PX, MAX_SIDE_PX)), min(grey.shape[:2]))
    corner = np.rint(scale * (scene.rays.xy[rows] + 0.5) - sides[:, None] / 2)
    corner = np.clip(corner, 0, np.array(grey.shape[1::-1]) - sides[:, None])
    windows = np.column_stack([corner, sides]).astype(np.int64).tolist()
    for k, (left, top, side) in zip(rows.tolist(), windows, strict=True):
        patch = grey[top : top + side, left : left + side]
        if side > CROP_PX:
            patch = cv2.resize(patch, (CROP_PX, CROP_PX), interpolation=cv2.INTER_AREA)
        frames[k] = (left / scale - 0.5, top / scale - 0.5, side / scale, len(patch))
        if wanted[k]:
            crops[k] = jpeg_of(patch, CROP_QUALITY)
        if with_files and with_cells:
            cells.append(patch)
    sheet = np.zeros((CROP_PX * -(-len(cells) // COLUMNS), CROP_PX * COLUMNS), np.uint8)
    for n, patch in enumerate(cells):  # crops as cells of one picture, by rows
        y, x = CROP_PX * (n // COLUMNS), CROP_PX * (n % COLUMNS)
        sheet[y : y + patch.shape[0], x : x + patch.shape[1]] = patch
    large = fitted_picture(grey, FILE_PX)
    view = fitted_picture(large, VIEW_PX)
    return _Cut(
        jpeg_of(fitted_picture(view, THUMBNAIL_PX), THUMBNAIL_QUALITY),
        jpeg_of(view, VIEW_QUALITY),
        jpeg_of(large, FILE_QUALITY) if with_files else b"",
        crops,
        frames,
        jpeg_of(sheet, CROP_QUALITY) if cells else b"",
    )


def _embed(
    scene: ViewerScene, cuts: list[_Cut | None], order: IntArray, budget: int, beside: str
) -> Pictures:
    """Choose the pictures that fit in the page, and name the others."""
    m = len(cuts)
    store = _Store()
    read = {i: cut for i, cut in enumerate(cuts) if cut is not None}
    worst = sorted(read, key=lambda i: -np.nan_to_num(scene.photo_rms_px[i]))
    room = int(THUMBNAILS_PART * budget)
    thumbnail = store.add_fitting({i: cut.thumbnail for i, cut in read.items()}, room)
    room = store.size + int(VIEWS_PART * (budget - store.size))
    view = store.add_fitting({i: read[i].view for i in worst}, room)
    crops = {k: crop for cut in read.values() for k, crop in cut.crops.items()}
    kept = store.add_fitting({k: crops[k] for k in order.tolist() if k in crops}, budget - 2)
    names = overlay_names(scene.photographs)
    files = {i: names[i] for i, cut in read.items() if cut.file}
    crop_files = {i: f"crops_{names[i]}" for i, cut in read.items() if cut.cells}
    content = {name: read[i].file for i, name in files.items()}
    content |= {name: read[i].cells for i, name in crop_files.items()}
    shown = [  # image point, frame, place in the page and cell in its file
        (k, frame, kept.get(k, (0, 0)), cell)
        for cut in read.values()
        for cell, (k, frame) in enumerate(cut.frames.items())
        if k in kept or cut.cells
    ]
    rays = sum(len(cut.frames) for cut in read.values())
    return Pictures(
        store.text(),
        len(read),
        _paths(beside, files, m),
        _paths(beside, crop_files, m),
        content,
        _places(thumbnail, m),
        _places(view, m),
        np.array([k for k, *_ in shown], dtype=np.int64),
        np.array([frame for _, frame, *_ in shown], dtype=float).reshape(-1, 4),
        np.array([place for *_, place, _ in shown], dtype=np.int64).reshape(-1, 2),
        np.array([cell for *_, cell in shown], dtype=np.int64),
        tuple(_notes_of(len(read), m, len(view), len(kept), rays, bool(beside))),
    )


def _paths(folder: str, names: Mapping[int, str], count: int) -> tuple[str, ...]:
    """Return the path of the file of each photograph from the page, "" without a file."""
    below = f"{folder}/" if folder else ""
    return tuple(f"{below}{names[i]}" if i in names else "" for i in range(count))


def _notes_of(read: int, m: int, views: int, crops: int, rays: int, beside: bool) -> list[str]:
    """Return in words what the page omits."""
    rest = "the rest is in the folder pictures beside it" if beside else "there was no room for the rest"
    lines = []
    if read < m:
        lines.append(f"{m - read} of {m} photographs could not be read: they have no picture here.")
    if views < read:
        lines.append(f"This page shows {views} of {read} photographs, those with the largest RMS; {rest}.")
    if crops < rays and read:
        lines.append(f"This page shows crops of {crops} of {rays} image points, the worst; {rest}.")
    return lines


class _Store:
    """Pictures one after another, each padded to whole groups of base64."""

    def __init__(self) -> None:
        self.parts: list[bytes] = []
        self.size = 0

    def add(self, data: bytes) -> tuple[int, int]:
        """Add a picture; return start and length in groups of three bytes, four characters of base64."""
        data += bytes(-len(data) % 3)
        start = self.size // 3
        self.parts.append(data)
        self.size += len(data)
        return start, len(data) // 3

    def add_fitting(self, pictures: Mapping[int, bytes], room: int) -> dict[int, tuple[int, int]]:
        """Add, in their order, the pictures that fit below a size in bytes; return starts and lengths."""
        places = {}
        for k, data in pictures.items():
            if self.size + len(data) <= room:
                places[k] = self.add(data)
        return places

    def text(self) -> str:
        return base64.b64encode(b"".join(self.parts)).decode()


def _none(count: int) -> IntArray:
    return np.zeros((count, 2), dtype=np.int64)


def _places(places: Mapping[int, tuple[int, int]], count: int) -> IntArray:
    """Return start and length of each picture by its number, 0 for those without a place, (count, 2)."""
    table = _none(count)
    for k, place in places.items():
        table[k] = place
    return table


@dataclass(frozen=True)
class Rays:
    """The image points of a network, rejected ones included, in the order of their object points."""

    point: IntArray  # index of the object point, in ascending order, (k,)
    photo: IntArray  # index of the photograph, (k,)
    xy: FloatArray  # measured position, px, (k, 2)
    v: FloatArray  # residual, computed minus measured, px; NaN if not known, (k, 2)
    w: FloatArray  # Baarda's w of both coordinates; NaN if not known, (k, 2)
    rejected: BoolArray  # whether it took no part, (k,)
    ellipse: FloatArray  # semi-axes, larger first, px, and angle, rad; NaN without an ellipse, (k, 3)

    def __len__(self) -> int:
        return len(self.point)

    @property
    def length(self) -> FloatArray:
        """Length of the residual vectors, px, (k,)."""
        return np.asarray(np.linalg.norm(self.v, axis=1))

    def worst_first(self) -> IntArray:
        """Return the rays by falling |w|, or by residual if w is not known; rejected ones first, (k,)."""
        size = np.where(np.isfinite(self.w).any(axis=1), np.fmax(*np.abs(self.w).T), self.length)
        return np.lexsort((np.arange(len(self)), -np.nan_to_num(size), ~self.rejected))


@dataclass(frozen=True)
class Marks:
    """Candidates in photographs that are not in the result."""

    photo: IntArray  # index of the photograph, in ascending order, (c,)
    xy: FloatArray  # px, (c, 2)
    reason: IntArray  # index into `reasons`, (c,)
    reasons: tuple[str, ...]  # in words, most important first

    @classmethod
    def none(cls) -> Marks:
        """Return no marks at all."""
        empty = np.zeros(0, dtype=np.int64)
        return cls(empty, np.zeros((0, 2)), empty, ())


@dataclass(frozen=True)
class Bar:
    """A scale bar."""

    start: int  # index of a point
    end: int
    length: float  # given, object unit
    sigma: float  # given, object unit
    difference: float  # adjusted minus given, object unit


@dataclass(frozen=True)
class ViewerScene:
    """A result to be explored in the viewer."""

    name: str
    unit: str  # of lengths
    cameras: tuple[Camera, ...]
    points: tuple[str, ...]  # names, n of them
    xyz: FloatArray  # object unit, (n, 3)
    covariance: FloatArray  # of each point alone, object unit^2; NaN if not known, (n, 3, 3)
    rays_of_point: IntArray  # accepted rays, (n,)
    angle_deg: FloatArray  # largest angle between two rays, deg; NaN with fewer than two, (n,)
    point_rms_px: FloatArray  # (n,)
    photographs: tuple[str, ...]  # names, m of them
    camera: IntArray  # index of the camera of each photograph, (m,)
    position: FloatArray  # projection centres, object unit, (m, 3)
    rotation: FloatArray  # image to object axes, (m, 3, 3)
    exterior_sigma: FloatArray  # of X0 Y0 Z0 (object unit), omega phi kappa (deg); NaN if not known, (m, 6)
    photo_rms_px: FloatArray  # (m,)
    points_of_photo: IntArray  # accepted image points, (m,)
    rays: Rays
    marks: Marks
    bars: tuple[Bar, ...]
    control: tuple[int, ...]  # indices of points
    distance_sigma: FloatArray | None  # of the distance of each pair of points i < j, by rows, object unit
    rms_px: float  # residual per coordinate over the accepted image points
    notes: tuple[str, ...] = ()  # what the page omits, one line each
    deviation: FloatArray | None = (
        None  # of points from their nominal shape, object unit; NaN if unknown, (n,)
    )
    displacement: FloatArray | None = (
        None  # of points since an earlier epoch, object unit; NaN likewise, (n, 3)
    )
    state: tuple[str, ...] = ()  # outcome of the test of each displacement, (n,)
    colour: AnyArray | None = None  # red, green and blue of points in the photographs, 0 to 255, (n, 3)


def distance_sigmas(xyz: FloatArray, covariance: FloatArray) -> FloatArray:
    """Return the standard deviation of the distance of each pair of points, from their joint covariance.

    With the unit vector u from point i to point j it is the root of u' (Qii + Qjj - Qij - Qji) u.

    Args:
        xyz: object unit, (n, 3).
        covariance: of all coordinates together, object unit^2, (3 n, 3 n).

    Returns:
        Standard deviations of pairs i < j, by rows, object unit, (n (n - 1) / 2,); NaN for coincident points.

    Source: law of propagation of variances; Luhmann et al., Close-Range Photogrammetry (2020), sec. 2.4.
    """
    n = len(xyz)
    Q = covariance.reshape(n, 3, n, 3)
    of_points = Q[np.arange(n), :, np.arange(n), :]
    rows = []
    for i in range(n - 1):
        u = xyz[i + 1 :] - xyz[i]
        length = np.linalg.norm(u, axis=1, keepdims=True)
        u = np.divide(u, length, out=np.full_like(u, np.nan), where=length > 0)
        cross = Q[i].transpose(1, 0, 2)[i + 1 :]
        of_difference = of_points[i] + of_points[i + 1 :] - cross - cross.transpose(0, 2, 1)
        variance = np.einsum("ja,jab,jb->j", u, of_difference, u)
        rows.append(np.sqrt(np.maximum(variance, 0.0)))
    return np.concatenate(rows) if rows else np.zeros(0)
