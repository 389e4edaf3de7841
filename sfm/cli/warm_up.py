"""Compiles the numba kernels before the first survey: `python -m sfm.cli.warm_up`.

Numba keeps compiled kernels on disk. Without them, the first run of each kind would take most of a minute
longer. Each part solves a small synthetic problem in a separate process, since numba compiles one function
at a time.
"""

from __future__ import annotations

import gc
import math
from concurrent.futures import ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from multiprocessing import get_context

import numpy as np

from sfm.adjustment.covariance import with_error_correlation
from sfm.adjustment.datum import Datum
from sfm.adjustment.result import ErrorCorrelation
from sfm.adjustment.solve import adjust
from sfm.comparison.solutions import reprojection
from sfm.comparison.two_adjusters.adjusters import common_problem
from sfm.judgement.hypotheses.hypotheses import judge_alternatives
from sfm.matching.conjugate import match_points
from sfm.matching.conjugate_patches import METHODS, MatchSettings
from sfm.matching.lsm.coverage import points_apart
from sfm.matching.tracks.correspondence import match_targets
from sfm.matching.tracks.feature_tracks import link_features
from sfm.matching.tracks.interest import foerstner_points, natural_points
from sfm.model.camera import camera_from_values, project
from sfm.model.conventions import AnyArray, rotation_from_angles
from sfm.model.errors import KolinearError
from sfm.model.estimate import Estimate
from sfm.model.network import ImagePoints, Network, empty_estimate
from sfm.orientation.incremental.sequence import orient
from sfm.orientation.resection.fischler_bolles import resect_fischler_bolles
from sfm.products.geometry.tolerance import Mesh
from sfm.products.planning.designer import gains
from sfm.products.planning.planned_object import box_tree, hidden_points
from sfm.products.rendering.render import render_photographs
from sfm.products.rendering.scene import CircularTargets, Faces, Optics, Scene, coded_ring
from sfm.runtime.progress import SILENT, Progress
from sfm.runtime.sampling import resample
from sfm.runtime.threads import cores
from sfm.runtime.warmed import set_warm
from sfm.targets.codes.plates import PlateFamily
from sfm.targets.codes.rings import ring_family
from sfm.targets.codes.tags import tag_family, tag_modules
from sfm.targets.detect import find_targets
from sfm.textbook.resection.zeng_wang import resect_zeng_wang

IMAGES, POINTS = 8, 40
SINGLE_IMAGES = 18  # enough unknowns for steps in single precision
MANY_IMAGES, MANY_POINTS = 80, 160  # too many photographs for a dense normal matrix to be the only choice
SEEN, RAYS = 12, 6  # points in each of these photographs; photographs of each point in a strip
SIZE_PX, PIXEL_MM, C_MM = (1000, 800), (0.01, 0.01), 10.0
DISTANCE = 4.0  # distance of the cameras from the origin; the points lie within 1 of it
NOISE_PX = 0.05
DOTS = ((60.3, 60.7), (180.1, 60.2), (60.4, 180.5), (180.6, 180.3))  # centres in the drawn photograph, px
FREE = ("c", "x0", "y0", "K1", "P1", "P2")


def compile_targets() -> None:
    """Find targets in drawn photographs: dark and bright, with cell rings, arcs, tags and checkerboards."""
    for bright in (False, True):
        for codes in ("ring14", "arcs", "apriltag36h11"):
            find_targets(drawn_photograph(bright), polarity="auto", codes=codes)
    black = np.pad(tag_modules(tag_family("apriltag36h11"), 3), 2)
    tag = np.where(np.kron(black, np.ones((12, 12))), 40, 200).astype(np.uint8)
    find_targets(tag, polarity="auto", codes="apriltag36h11")
    squares = np.where(np.add.outer(np.arange(7), np.arange(8)) % 2, 40, 200).astype(np.uint8)
    find_targets(squares.repeat(30, 0).repeat(30, 1), codes=PlateFamily("checkerboard", 6, 7))


def compile_orientation() -> None:
    """Orient a network from its image points alone, match the points without names, and resect."""
    network, truth = made_up_network()
    orient(network, empty_estimate(network, truth.cameras), refine=lambda _, estimate: estimate)
    seen = network.image_points
    match_targets(
        truth,
        network.camera,
        [seen.xy[seen.image == i] for i in range(IMAGES)],
        tolerance_px=1.0,
        diameters_px=[np.full(int((seen.image == i).sum()), 10.0) for i in range(IMAGES)],
    )
    corners, above = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]), np.array([0.3, 0.3, 3.0])
    for method in (resect_zeng_wang, resect_fischler_bolles):
        method((corners - above)[:, :2] / above[2], corners)


def compile_adjustment() -> None:
    """Adjust networks in all the ways that a survey uses, judge one, and prepare a comparison."""
    network, truth = made_up_network()
    adjust(network, truth, datum=Datum("free"), reject="huber", covariance=False)
    adjustment = adjust(network, truth, datum=Datum("free"), reject="tau")
    judge_alternatives(adjustment)
    part, start, _, _ = common_problem(adjustment)
    compared = adjust(part, start, datum=Datum("free"), reject="none")
    neighbours = ErrorCorrelation(alone=1.0, common=0.1, length_px=100.0)
    assert (
        with_error_correlation(adjustment, neighbours).solution.with_joint_covariance.covariance is not None
    )
    reprojection(part, compared.estimate)
    every = np.ones((SINGLE_IMAGES, POINTS), dtype=bool)
    # normal matrices of three forms: factored by fronts, summed ray by ray, and a product in single precision
    for sees in (_strip(), _scattered(), every):
        adjust(*made_up_network(sees), datum=Datum("free"), reject="none")


def compile_matching() -> None:
    """Find interest points, match some by correlation and by least squares in all models, link features."""
    photograph = drawn_photograph(False)
    at = foerstner_points(photograph, border_px=30).xy[:4]
    for method in METHODS:
        match_points(photograph, photograph, at, settings=MatchSettings(method=method, search_px=41))
    resample(photograph, at)
    cells = np.random.default_rng(4).integers(0, 255, (60, 60)).astype(np.uint8)
    texture = np.kron(cells, np.ones((5, 5), dtype=np.uint8))
    parts = [np.ascontiguousarray(texture[:, shift : shift + 240]) for shift in (0, 20, 40)]
    link_features([natural_points(part) for part in parts])
    network, _ = made_up_network()
    points_apart(network.image_points, np.ones(IMAGES * POINTS, dtype=bool), 21.0, n_points=POINTS)


def compile_planning() -> None:
    """Render a photograph of a coded target, and find points hidden by a triangle, as planning does."""
    face = Faces(np.zeros((1, 3)), np.eye(3)[None, :2], np.ones((1, 2)), *np.array([[0.8], [0.0], [1.0]]))
    ring = coded_ring(0, np.zeros(2), 0.1, 20, ring_family("ring14"), 0.1)
    target = CircularTargets(np.zeros(1, dtype=np.int64), np.zeros((1, 2)), np.full(1, 0.1), np.full(1, 20))
    camera = camera_from_values("camera", "brown", (60, 50), (0.1, 0.1), c_mm=C_MM)
    above, down = np.array([[0.0, 0.0, DISTANCE]]), rotation_from_angles(0.0, 0.0, 0.0)[None]
    render_photographs(Scene(face, ring, target), camera, above, down, optics=Optics(), seed=1, threads=1)
    triangle = Mesh(np.eye(3), np.array([[0, 1, 2]]))
    hidden_points(box_tree(triangle), above[0], np.zeros((1, 3)))
    gains(np.eye(3)[None], np.ones((1, 1, 2, 3)), np.ones(1), np.ones(1, dtype=bool))


PARTS = (  # longest first
    compile_orientation,
    compile_targets,
    compile_adjustment,
    compile_matching,
    compile_planning,
)


def main(progress: Progress = SILENT) -> None:
    """Compile all parts, as many at a time as there are cores.

    Args:
        progress: is advanced when a part is finished.

    Raises:
        KolinearError: a process was ended by the system.
    """
    progress.stage("compiling", len(PARTS))
    # Without garbage collection: searching the many objects of the compiler for cycles would take a tenth of
    # the time. The cycles use 0.2 GB, which the end of the process frees.
    with ProcessPoolExecutor(
        min(cores(), len(PARTS)), mp_context=get_context("spawn"), initializer=gc.disable
    ) as pool:
        for done in as_completed(map(pool.submit, PARTS)):
            try:
                done.result()
            except BrokenProcessPool as error:
                raise KolinearError(
                    "a process that compiles kernels was ended, as where memory is limited (ulimit -v); "
                    "needed more memory until `python -m sfm.cli.warm_up` has run"
                ) from error
            progress.advance()
    set_warm()


def made_up_network(sees: AnyArray | None = None) -> tuple[Network, Estimate]:
    """Return a synthetic convergent network with little noise, and its true values.

    Args:
        sees: which photographs see which points, (photographs, points); if not given, each of a few
            photographs sees every point.
    """
    sees = np.ones((IMAGES, POINTS), dtype=bool) if sees is None else sees
    images, count = sees.shape
    rng = np.random.default_rng(1)
    camera = camera_from_values(
        "camera", "brown", SIZE_PX, PIXEL_MM, c_mm=C_MM, free=FREE, values=(("K1", 1e-4),)
    )
    points = rng.uniform(-0.7, 0.7, (count, 3))
    angle = 2 * np.pi * np.arange(images) / images
    position = DISTANCE * np.stack([0.7 * np.cos(angle), 0.7 * np.sin(angle), np.full(images, 0.7)], axis=1)
    back = position / np.linalg.norm(position, axis=1)[:, None]
    right = np.stack([-np.sin(angle), np.cos(angle), np.zeros(images)], axis=1)
    down = np.cross(back, right)
    rotation = np.stack([right, down, back], axis=2)
    rotation[1::2] = np.stack([down, -right, back], axis=2)[1::2]  # rolled, which determines the camera
    xy = np.stack(
        [project(camera, X0, R, points) for X0, R in zip(position, rotation, strict=True)]
    ) + rng.normal(0, NOISE_PX, (images, count, 2))
    image, point = np.nonzero(sees)
    network = Network(
        tuple(f"photograph {i}" for i in range(images)),
        np.zeros(images, dtype=np.int64),
        tuple(str(j) for j in range(count)),
        ImagePoints(image, point, xy[image, point], np.tile(np.eye(2) * NOISE_PX**2, (len(image), 1, 1))),
    )
    return network, Estimate((camera,), position, rotation, points)


def _strip() -> AnyArray:
    """Return which points each photograph sees if it shares points with its neighbours only."""
    first = np.arange(MANY_POINTS) * (MANY_IMAGES - RAYS) // (MANY_POINTS - 1)
    i = np.arange(MANY_IMAGES)[:, None]
    return np.asarray((first <= i) & (i < first + RAYS))


def _scattered() -> AnyArray:
    """Return which points each photograph sees if it shares a few points with any other."""
    rng = np.random.default_rng(3)
    return np.asarray(rng.random((MANY_IMAGES, MANY_POINTS)).argsort(axis=1) < SEEN)


def drawn_photograph(bright: bool) -> AnyArray:
    """Return a small photograph with four dots, one of them in a ring of cells."""
    family = ring_family("ring14")
    pattern = int(family.pattern[20])
    y, x = np.mgrid[:240, :240]
    light = np.zeros((240, 240))
    for cx, cy in DOTS:
        light += np.clip(8.5 - np.hypot(x - cx, y - cy), 0, 1)
    r, angle = np.hypot(x - 60.3, y - 60.7), np.arctan2(y - 60.7, x - 60.3) % (2 * math.pi)
    cell = (angle / (2 * math.pi) * family.cells).astype(int)
    ring = np.clip(r - 8.5 * family.inner, 0, 1) * np.clip(8.5 * family.outer - r, 0, 1)
    light += ring * ((pattern >> (family.cells - 1 - cell)) & 1)
    noise = np.random.default_rng(2).normal(0, 2, light.shape)
    return np.clip((40 + 160 * light if bright else 200 - 160 * light) + noise, 0, 255).astype(np.uint8)


if __name__ == "__main__":
    main()
