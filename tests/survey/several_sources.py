"""A folded, textured sheet with coded targets and given points: what one survey of all states and reaches.

    python -m tests.survey.several_sources [FIRST] [END]

Of 30 photographs ten or more show fewer than three of the twelve targets. Each number from FIRST to END
chooses texture, stations, noise, given image points, and the error of the scale bar. For each source of image
points, errors are those of its points after a similarity onto the targets. Those of texture are distances
from the sheet, away from its edges. What is stated has the same datum (Baarda 1973, S-transformations).
"""

from __future__ import annotations

import sys
import tempfile
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np

from sfm.adjustment.covariance import marginal_of
from sfm.adjustment.result import Adjustment
from sfm.model.camera import project
from sfm.model.conventions import FloatArray, IntArray
from sfm.model.remarks.remark import kinds_of
from sfm.model.similarity import fit_similarity
from sfm.pipeline import run_survey
from sfm.products.planning.stations import aim_camera
from sfm.products.rendering.render import render_photographs
from sfm.products.rendering.scene import (
    CircularTargets,
    Faces,
    Optics,
    Scene,
    coded_ring,
    join_marks,
    rectangles,
)
from sfm.survey.inputs.survey import read_survey
from sfm.targets.codes.plates import code_family
from sfm.targets.codes.rings import CodeFamily
from tests.surveys import camera
from tests.synthetic import seed_of

NUMBERS = 20  # of the study
COLUMNS, ROWS_OF_STATIONS = 10, 3
NOISE = 2.0  # grey values
FOLDS = 6  # of the sheet
RUN, RISE, HALF_WIDTH = 150.0, 50.0, 160.0  # of a fold along X and Z, and of the sheet along Y, mm
TARGETS = [  # fold, and place along the fold and along Y, mm
    *((2, x, y) for x, y in ((40.0, -110.0), (30.0, 95.0))),
    *((3, x, y) for x, y in ((-30.0, -100.0), (25.0, 0.0), (-20.0, 110.0))),
    *((4, x, y) for x, y in ((-35.0, -60.0), (20.0, 120.0), (35.0, -120.0), (-20.0, 40.0))),
    *((5, x, y) for x, y in ((-25.0, -95.0), (30.0, 10.0), (-5.0, 105.0))),
]
RADIUS, PAPER = 6.0, 21.0  # of a dot, and half the side of the paper around a target, mm
GIVEN = 20  # points
GIVEN_PX = 0.2  # standard deviation of given image points
GIVEN_IN = 12  # photographs that a given point is measured in, at most
BAR = 1e-5  # standard deviation of the scale bar over its length
FREE_MM = 20.0  # from an edge; windows of 21 px do not reach so far
TEXTURED = 300  # points of texture of which errors are compared with what is stated

SURVEY = """\
[survey]
name = "sources"
unit = "mm"
[[camera]]
name = "small"
images = "*.png"
pixel_mm = [0.01, 0.01]
c_mm = 8.05
free = ["c", "x0", "y0", "K1"]
[compare]
backend = "none"
"""
OF_TARGETS = '[targets]\npolarity = "dark"\ncodes = "ring14"\n'
OF_TEXTURE = '[targets]\ncodes = "none"\n[tie_points]\n'
OF_ALL = OF_TARGETS + '[tie_points]\n[[observations]]\nfile = "given.csv"\nsigma_px = 0.2\n'


@dataclass(frozen=True)
class Sheet:
    """The scene of a number, its stations, and where its points are."""

    scene: Scene
    position: FloatArray  # (m, 3)
    rotation: FloatArray  # (m, 3, 3)
    points: dict[str, FloatArray]  # targets and given points by their names, mm


def faces_of_sheet() -> Faces:
    """Return the folds, which meet in edges along Y."""
    up = np.where(np.arange(FOLDS) % 2 == 0, 1.0, -1.0)
    along = np.column_stack([np.full(FOLDS, RUN), np.zeros(FOLDS), up * RISE])
    length = np.linalg.norm(along, axis=1)
    axes = np.stack([along / length[:, None], np.tile([0.0, 1.0, 0.0], (FOLDS, 1))], axis=1)
    middle = np.column_stack(
        [RUN * (np.arange(FOLDS) + 0.5 - FOLDS / 2), np.zeros(FOLDS), np.full(FOLDS, RISE / 2)]
    )
    half = np.column_stack([length / 2, np.full(FOLDS, HALF_WIDTH)])
    return Faces(middle, axes, half, np.full(FOLDS, 0.75), np.full(FOLDS, 0.2), np.full(FOLDS, 3.0))


def sheet_of(number: int) -> Sheet:
    """Return the sheet of a number."""
    rng = seed_of(f"sheet {number}")
    faces = faces_of_sheet()
    family = code_family("ring14")
    assert isinstance(family, CodeFamily)
    marks = []
    for k, (face, x, y) in enumerate(TARGETS):
        at = np.array([x, y])
        marks += [
            rectangles(face, at[None], np.full((1, 2), PAPER), np.zeros(1), np.full(1, 0.8)),
            coded_ring(face, at, RADIUS, 5 + 3 * k, family, 0.08, turn=rng.uniform(0, 2 * np.pi)),
        ]
    of_face, *_ = np.array(TARGETS).T
    centre = np.array(TARGETS)[:, 1:]
    targets = CircularTargets(
        of_face.astype(np.int64), centre, np.full(len(TARGETS), RADIUS), 5 + 3 * np.arange(len(TARGETS))
    )
    scene = Scene(_with_other_texture(faces, number), join_marks(marks), targets)
    xyz = faces.place(targets.face, centre)
    points = {str(code): X for code, X in zip(targets.code.tolist(), xyz, strict=True)}
    on = rng.integers(0, FOLDS, GIVEN)
    places = rng.uniform(-0.9, 0.9, (GIVEN, 2)) * faces.half[on]
    points |= {f"given {k + 1}": X for k, X in enumerate(faces.place(on, places))}
    return Sheet(scene, *_stations(rng), points)


def _with_other_texture(faces: Faces, number: int) -> Faces:
    """Return the folds where the texture of a number is, which the lengths of its grains make."""
    return replace(faces, grain=faces.grain * (1 + 0.005 * number))


def _stations(rng: np.random.Generator) -> tuple[FloatArray, FloatArray]:
    """Return stations in rows along the sheet, which look at it from both sides and from above."""
    along = np.linspace(-RUN * FOLDS / 2 + 70, RUN * FOLDS / 2 - 70, COLUMNS)
    position, rotation = [], []
    for k, x in enumerate(along):
        for row, y in enumerate((-260.0, 0.0, 260.0)):
            aim = np.array([x, 0.0, RISE / 2]) + rng.uniform(-15, 15, 3) * [1, 1, 0]
            at = np.array([x + (60.0 if k % 2 else -60.0), y, 500.0 if row == 1 else 430.0])
            at += rng.uniform(-20, 20, 3)
            position.append(at)
            rotation.append(aim_camera(aim - at, np.pi / 2 * ((k + row) % 4) + rng.uniform(-0.1, 0.1)))
    return np.array(position), np.array(rotation)


def write(folder: Path, number: int) -> Sheet:
    """Write photographs, given image points, and surveys of all sources and of each alone."""
    sheet, rng = sheet_of(number), seed_of(f"noise {number}")
    optics = Optics(blur_px=0.7, exposure=0.9)
    pictures, _ = render_photographs(
        sheet.scene, camera(), sheet.position, sheet.rotation, optics=optics, seed=number, threads=1
    )
    for i, picture in enumerate(pictures):
        noisy = np.rint(picture + NOISE * rng.standard_normal(picture.shape))
        cv2.imwrite(str(folder / f"{i:02d}.png"), np.clip(noisy, 0, 255).astype(np.uint8))
    lines, size = ["image,point,x_px,y_px"], np.array(camera().size_px)
    names = [name for name in sheet.points if name.startswith("given")]
    X = np.array([sheet.points[name] for name in names])
    shown = np.array([project(camera(), *one, X) for one in zip(sheet.position, sheet.rotation, strict=True)])
    inside = ((shown > 5) & (shown < size - 6)).all(axis=2)
    for j, name in enumerate(names):
        for i in rng.permutation(np.flatnonzero(inside[:, j]))[:GIVEN_IN].tolist():
            x, y = (shown[i, j] + GIVEN_PX * rng.standard_normal(2)).tolist()
            lines.append(f"{i:02d}.png,{name},{x},{y}")
    (folder / "given.csv").write_text("\n".join(lines) + "\n", "utf-8")
    start, end = "5", str(5 + 3 * (len(TARGETS) - 1))
    length = float(np.linalg.norm(sheet.points[end] - sheet.points[start]))
    given = length * (1 + BAR * rng.standard_normal())
    bar = f'[[scale_bar]]\nfrom = "{start}"\nto = "{end}"\nlength = {given}\nsigma = {BAR * length}\n'
    for name, text in (("all", OF_ALL + bar), ("targets", OF_TARGETS + bar), ("texture", OF_TEXTURE)):
        (folder / f"{name}.toml").write_text(SURVEY + text, "utf-8")
    return sheet


def distances(X: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the distances of points from the fold over which they are, mm, (n,), and its normals, (n, 3)."""
    faces = faces_of_sheet()
    face = np.clip((X[:, 0] / RUN + FOLDS / 2).astype(np.int64), 0, FOLDS - 1)
    normal = faces.normals()[face]
    return np.einsum("ni,ni->n", X - faces.centre[face], normal), normal


def from_edges(X: FloatArray) -> FloatArray:
    """Return how far points are from the nearest fold or border of the sheet, mm, (n,); negative outside."""
    to_fold = np.abs(X[:, 0] - RUN * np.rint(X[:, 0] / RUN))
    return np.minimum(np.minimum(to_fold, HALF_WIDTH - np.abs(X[:, 1])), RUN * FOLDS / 2 - np.abs(X[:, 0]))


@dataclass(frozen=True)
class Accuracy:
    """Errors of the points of a source, and what is stated for them."""

    rms: float  # mm
    stated: float  # root of the mean stated variance, mm
    relative: float  # RMS of the errors over their standard deviations

    @classmethod
    def of(cls, squares: FloatArray, variances: FloatArray) -> Accuracy:
        """Return the accuracy of points from the squares of their errors and their variances, mm^2, (n,)."""
        return cls(*np.sqrt([squares.mean(), variances.mean(), (squares / variances).mean()]).tolist())


def onto(X: FloatArray, held: int) -> FloatArray:
    """Return the S-transformation of n points to the datum of the first `held`, (3n, 3n)."""
    centred = X - X[:held].mean(axis=0)
    G = np.zeros((len(X), 3, 7))
    G[:, :, :3] = np.eye(3)
    G[:, :, 3:6] = -np.cross(centred[:, None], np.eye(3)[None]).transpose(0, 2, 1)
    G[:, :, 6] = centred
    G = G.reshape(3 * len(X), 7)
    B = G.copy()
    B[3 * held :] = 0.0
    return np.asarray(np.eye(3 * len(X)) - G @ np.linalg.solve(B.T @ B, B.T))


def _rows(a: Adjustment, sheet: Sheet, *, targets: bool) -> tuple[IntArray, FloatArray]:
    """Return the rows of the targets, or of the given points, and their true coordinates."""
    rows = [
        j for j, name in enumerate(a.network.points) if name in sheet.points and name.isdigit() == targets
    ]
    return np.array(rows), np.array([sheet.points[a.network.points[j]] for j in rows])


def accuracies(a: Adjustment, sheet: Sheet) -> dict[str, Accuracy]:
    """Return the errors of the points of each source, after a similarity onto the targets.

    Windows that reach over an edge measure no plane; of them nothing is asked.
    """
    (targets, truth), (given, of_given) = (_rows(a, sheet, targets=one) for one in (True, False))
    placed = fit_similarity(a.estimate.points[targets], truth)
    of_texture = np.flatnonzero(~a.network.named)
    of_texture = of_texture[from_edges(placed.apply(a.estimate.points[of_texture])) > FREE_MM]
    of_texture = of_texture[:: max(1, len(of_texture) // TEXTURED)]
    every = np.concatenate([targets, given, of_texture])
    X = placed.apply(a.estimate.points[every])
    T = placed.scale * np.kron(np.eye(len(every)), placed.rotation)
    S = onto(X, len(targets)) @ T
    C = S @ marginal_of(a).joint(np.zeros(0, dtype=np.int64), every) @ S.T
    blocks = C.reshape(len(every), 3, len(every), 3)[range(len(every)), :, range(len(every))]
    found, first = {}, 0
    for name, true in (("targets", truth), ("given", of_given)):
        of = slice(first, first + len(true))
        first = of.stop
        square = ((X[of] - true) ** 2).sum(axis=1)
        found[name] = Accuracy.of(square, np.einsum("nii->n", blocks[of]))
    off, normal = distances(X[first:])
    across = np.einsum("ni,nij,nj->n", normal, blocks[first:], normal)
    return found | {"texture": Accuracy.of(off**2, across)}


def on_texture(a: Adjustment, sheet: Sheet) -> float:
    """Return the distance of the points of texture from the sheet, RMS, after a similarity of themselves, mm.

    The similarity is that onto the places of the sheet that their first photograph shows where they are.
    """
    seen = a.network.image_points
    rows = np.flatnonzero(~a.network.named)
    first = np.unique(seen.point, return_index=True)[1][rows]
    place = np.array([int(name[:2]) for name in a.network.images])[seen.image[first]]
    xy, c = seen.xy[first], camera()
    uv = (xy - (np.array(c.size_px) - 1) / 2) * [1, -1] / c.c_px
    ray = np.einsum("nij,nj->ni", sheet.rotation[place], np.column_stack([uv, -np.ones(len(uv))]))
    X = np.full((len(rows), 3), np.nan)
    faces, centre = faces_of_sheet(), sheet.position[place]
    for f, normal in enumerate(faces.normals()):
        t = (faces.centre[f] - centre) @ normal / (ray @ normal)
        hit = centre + t[:, None] * ray
        of = np.clip((hit[:, 0] / RUN + FOLDS / 2).astype(np.int64), 0, FOLDS - 1) == f
        X[of] = hit[of]
    known = np.isfinite(X).all(axis=1)
    plain = known & (from_edges(X) > FREE_MM)
    placed = fit_similarity(a.estimate.points[rows[plain]], X[plain])
    at = placed.apply(a.estimate.points[rows[known]])
    off, _ = distances(at[from_edges(at) > FREE_MM])
    return float(np.sqrt((off**2).mean()))


def on_targets(a: Adjustment, sheet: Sheet) -> float:
    """Return the error of the targets, RMS, after a similarity onto themselves, mm."""
    rows, truth = _rows(a, sheet, targets=True)
    error = fit_similarity(a.estimate.points[rows], truth).apply(a.estimate.points[rows]) - truth
    return float(np.sqrt((error**2).sum(axis=1).mean()))


def scale_error(a: Adjustment, sheet: Sheet) -> tuple[float, float]:
    """Return the relative error of the scale of the targets, and its standard deviation."""
    rows, truth = _rows(a, sheet, targets=True)
    placed = fit_similarity(a.estimate.points[rows], truth)
    C = marginal_of(a).joint(np.zeros(0, dtype=np.int64), rows)
    X = a.estimate.points[rows]
    centred = X - X.mean(axis=0)
    g = (centred / (centred**2).sum()).ravel()
    return 1 / placed.scale - 1, float(np.sqrt(g @ C @ g))


@dataclass(frozen=True)
class Outcome:
    """What the survey of a number gives."""

    oriented: int
    few_targets: int  # photographs with fewer than three targets
    points: int  # of texture
    accuracy: dict[str, Accuracy]
    of_targets: tuple[float, float]  # RMS error of targets of this survey, and of that of targets alone, mm
    of_texture: tuple[float, float]  # the same of texture
    scale: tuple[float, float]  # relative error of the scale, and its standard deviation
    level: str  # of the verdict
    kinds: tuple[str, ...]  # of remarks


def outcome_of(number: int) -> Outcome:
    """Return what the surveys of a number give."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        sheet = write(folder, number)
        both, targets, texture = (
            run_survey(read_survey(folder / f"{one}.toml")) for one in ("all", "targets", "texture")
        )
    a = both.adjustment
    seen = a.network.image_points
    of_target = a.network.source == 0
    count = np.bincount(seen.image[of_target], minlength=len(a.network.images))
    return Outcome(
        int(a.estimate.oriented.sum()),
        int((count < 3).sum()),
        int((~a.network.named).sum()),
        accuracies(a, sheet),
        (on_targets(a, sheet), on_targets(targets.adjustment, sheet)),
        (on_texture(a, sheet), on_texture(texture.adjustment, sheet)),
        scale_error(a, sheet),
        both.verdict.level,
        kinds_of(both.verdict.remarks),
    )


def study(first: int, end: int) -> list[Outcome]:
    """Run the surveys of some numbers and print a line for each."""
    found = []
    for number in range(first, end):
        one = outcome_of(number)
        found.append(one)
        ratios = "  ".join(
            f"{name} {it.rms:.4f} mm = {it.relative:.2f} sigma" for name, it in one.accuracy.items()
        )
        print(
            f"{number:>2} {one.level:<5}{one.oriented} photographs, {one.few_targets} with few targets, "
            f"{one.points} of texture: {ratios}; alone "
            + ", ".join(
                f"{name} {these[0]:.4f} to {these[1]:.4f}"
                for name, these in (("targets", one.of_targets), ("texture", one.of_texture))
            )
            + f"; scale {1e6 * one.scale[0]:.1f} +- {1e6 * one.scale[1]:.1f} ppm  {', '.join(one.kinds)}",
            flush=True,
        )
    return found


if __name__ == "__main__":
    numbers = [int(one) for one in sys.argv[1:]] or [0, NUMBERS]
    study(numbers[0], numbers[1])
