"""COLMAP through pycolmap: its Ceres bundle adjustment and covariances of Kolinear's networks.

Only this module imports pycolmap. COLMAP's adjuster has two limits compared with Kolinear's:

    weights        every image coordinate has the same weight
    constants      focal lengths, principal points and distortion are freed in groups, for all cameras

`adapters.colmap.reconstruction` converts pixel origin and axes.

Source: COLMAP 4.2 documentation, "Output Format" and "Camera Models"; COLMAP 4.2, estimate_ba_covariance.
"""

from __future__ import annotations

import re
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from types import ModuleType
from typing import Any

import numpy as np

from adapters.colmap.reconstruction import estimate_of, reconstruction, residuals_of, sensor_of
from sfm.files.plain_text import as_plain
from sfm.model.camera import Camera
from sfm.model.conventions import FloatArray
from sfm.model.display import counted
from sfm.model.errors import BackendError, MissingLibraryError, one_line
from sfm.model.estimate import Estimate
from sfm.model.network import Network

NEEDED_VERSION = (4, 2)
# From the default trust region radius of 1e4 Ceres converges slowly: 46 steps on 400 photographs, 6 with 1e8.
# The steps are then Gauss-Newton's. Ceres' default tolerances stop long before the last digits.
START_RADIUS = 1e8
MAX_RADIUS = 1e32
MIN_LM_DIAGONAL = 1e-30
STILL = 1e-13  # relative decrease of the cost below which another run of Ceres has nothing to add
MAX_RUNS = 8
MAX_TOLD = 200  # maximum length of COLMAP's error text, characters
DENSE_LIMIT = 200  # photographs up to which the reduced normal matrix is factorised densely


@dataclass(frozen=True)
class ColmapAdjustment:
    """Result of COLMAP's bundle adjuster on a network."""

    estimate: Estimate  # adjusted, in the gauge that Ceres ended in
    residuals: FloatArray  # computed - measured, px, pixel frame, NaN behind the camera, (k, 2)
    rms_px: float  # root mean square residual per coordinate, px; NaN if points ended behind cameras
    cost: float  # half the sum of squared residuals, px^2; NaN likewise
    iterations: int  # steps of Ceres, including unsuccessful ones
    converged: bool  # whether Ceres met a convergence criterion
    message: str  # why Ceres stopped
    seconds: float  # time in Ceres, s; without building the problem
    # Of the points with photographs and cameras held, for image points of standard deviation 1 px, object
    # unit^2, (n, 3, 3); None if not requested.
    point_covariance: FloatArray | None = None


def adjust_with_colmap(
    network: Network,
    estimate: Estimate,
    *,
    gauge: str = "free",
    threads: int = 1,
    max_iterations: int = 200,
    polish: bool = True,
) -> ColmapAdjustment:
    """Adjust a network with COLMAP's Ceres adjuster, all image coordinates with unit weight.

    The parameters declared as free by the cameras of the estimate are adjusted; see `colmap_free`.

    Args:
        network: photographs, points and image points; all image points take part.
        estimate: complete start values, with cameras in a model that COLMAP has.
        gauge: free | two_cameras | control. "free" leaves the datum to Ceres' damping, which moves it little.
            "two_cameras" fixes 7 elements of the first two photographs; from a poor start this can move
            points behind cameras. "control" fixes the control points.
        threads: threads of Ceres.
        max_iterations: steps per run of Ceres.
        polish: whether to run Ceres again from its last result until the cost stays constant.

    Raises:
        BackendError: pycolmap is missing or has another version, COLMAP cannot express a camera model or a
            set of free parameters, control has weights, or Ceres fails.
    """
    pycolmap = load_pycolmap()
    refine = colmap_free(estimate.cameras)
    options = ceres_options(pycolmap, refine, len(network.images), threads, max_iterations)
    with quiet(pycolmap):
        options.refine_sensor_from_rig = estimate.mounts is not None and bool(estimate.mounts.free.any())
        scene = reconstruction(pycolmap, network, estimate)
        config = adjustment_config(pycolmap, network, estimate, gauge)
        iterations, seconds, converged, message = 0, 0.0, False, ""
        cost = np.inf
        for _ in range(MAX_RUNS if polish else 1):
            adjuster = pycolmap.create_default_ceres_bundle_adjuster(options, config, scene)
            started = time.perf_counter()
            summary = adjuster.solve().ceres_summary
            seconds += time.perf_counter() - started
            iterations += summary.num_successful_steps + summary.num_unsuccessful_steps
            converged = summary.termination_type.name == "CONVERGENCE"
            message = summary.message
            if not summary.IsSolutionUsable():
                raise BackendError(f"COLMAP's adjuster failed: {summary.message}")
            still = abs(cost - summary.final_cost) <= STILL * summary.final_cost
            cost = summary.final_cost
            if still:
                converged = True
                break
        adjusted = estimate_of(scene, estimate)
        residuals = residuals_of(scene, network)
    behind = int(np.isnan(residuals[:, 0]).sum())
    if behind:
        # Ceres gives such points no residual, so losing a point behind a camera lowers its cost.
        converged, message = False, f"{counted(behind, 'image point')} ended behind their camera"
    return ColmapAdjustment(
        adjusted,
        residuals,
        float(np.sqrt((residuals**2).mean())),
        float((residuals**2).sum() / 2),
        iterations,
        converged,
        message,
        seconds,
    )


def colmap_free(cameras: tuple[Camera, ...]) -> tuple[bool, bool, bool]:
    """Return whether focal lengths, principal points and distortion are free, in COLMAP's groups.

    Raises:
        BackendError: a group is free in part, or in some of the cameras that are not fixed as a whole.
    """
    settings: set[tuple[bool, bool, bool]] = set()
    for camera in cameras:
        if not camera.free.any():
            continue
        groups = [camera.free[part] for part in camera.parts]
        for name, group in zip(("focal length", "principal point", "distortion"), groups, strict=True):
            if group.any() and not group.all():
                raise BackendError(
                    f"camera {camera.name}: its {name} is partly free; COLMAP frees all of it or nothing"
                )
        settings.add((bool(groups[0].any()), bool(groups[1].any()), bool(groups[2].any())))
    if len(settings) > 1:
        raise BackendError("cameras with different free parameters: COLMAP frees the same in all of them")
    return settings.pop() if settings else (False, False, False)


def load_pycolmap() -> ModuleType:
    """Import pycolmap, or state what is needed.

    Raises:
        MissingLibraryError: pycolmap is not installed.
        BackendError: pycolmap cannot be imported, or is another version.
    """
    needed = ".".join(str(part) for part in NEEDED_VERSION)
    try:
        import pycolmap
        import pycolmap.pyceres  # registers the types of the Ceres options
    except ImportError as error:
        if isinstance(error, ModuleNotFoundError) and error.name == "pycolmap":
            raise MissingLibraryError(
                f"pycolmap is not installed: pip install 'pycolmap=={needed}.*'"
            ) from error
        raise BackendError(
            f"pycolmap cannot be imported ({one_line(error)}): pip install 'pycolmap=={needed}.*'"
        ) from error
    installed = tuple(int(part) for part in pycolmap.__version__.split(".")[:2])
    if installed != NEEDED_VERSION:
        raise BackendError(
            f"pycolmap {pycolmap.__version__} is installed, {needed} is needed: "
            f"pip install 'pycolmap=={needed}.*'"
        )
    return pycolmap


@contextmanager
def quiet(pycolmap: ModuleType) -> Iterator[None]:
    """Suppress the log of COLMAP and Ceres in the terminal, and restore its levels afterwards."""
    log = pycolmap.logging
    before = log.minloglevel, log.stderrthreshold
    log.minloglevel = log.stderrthreshold = int(log.Level.FATAL)
    try:
        yield
    finally:
        log.minloglevel, log.stderrthreshold = before


def ceres_options(
    pycolmap: ModuleType, refine: tuple[bool, bool, bool], images: int, threads: int, max_iterations: int
) -> Any:
    """Return options for a Ceres run to the end of double precision, with nearly undamped steps."""
    options = pycolmap.BundleAdjustmentOptions()
    options.refine_focal_length, options.refine_principal_point, options.refine_extra_params = refine
    options.print_summary = False
    options.ceres.auto_select_solver_type = False
    options.ceres.min_num_residuals_for_cpu_multi_threading = 0
    solver = options.ceres.solver_options
    kinds = pycolmap.pyceres.LinearSolverType
    solver.linear_solver_type = kinds.DENSE_SCHUR if images <= DENSE_LIMIT else kinds.SPARSE_SCHUR
    solver.num_threads = threads
    solver.max_num_iterations = max_iterations
    solver.initial_trust_region_radius = START_RADIUS
    solver.max_trust_region_radius = MAX_RADIUS
    solver.min_lm_diagonal = MIN_LM_DIAGONAL
    solver.function_tolerance = solver.gradient_tolerance = solver.parameter_tolerance = 1e-16
    return options


def adjustment_config(pycolmap: ModuleType, network: Network, estimate: Estimate, gauge: str) -> Any:
    """Return the configuration: which photographs take part, and what is held.

    Raises:
        BackendError: an unknown gauge, or control with standard deviations.
    """
    config = pycolmap.BundleAdjustmentConfig()
    for i in range(len(network.images)):
        config.add_image(i + 1)
    for k, camera in enumerate(estimate.cameras):
        if not camera.free.any():
            config.set_constant_cam_intrinsics(k + 1)
    mounts = estimate.mounts
    for k in range(0 if mounts is None else len(mounts.rig)):
        if mounts is not None and mounts.rig[k] and not mounts.free[k].any():
            config.set_constant_sensor_from_rig_pose(sensor_of(pycolmap, k))
    if gauge == "two_cameras":
        config.fix_gauge(pycolmap.BundleAdjustmentGauge.TWO_CAMS_FROM_WORLD)
    elif gauge == "control":
        if network.control.covariance.any():
            raise BackendError(
                "control with standard deviations: COLMAP's adjuster fixes points or frees them"
            )
        for j in network.control.point:
            config.add_constant_point(int(j) + 1)
    elif gauge != "free":
        raise BackendError(f"gauge '{gauge}', expected one of two_cameras, free, control")
    return config


def reason_of(error: BaseException) -> str:
    """Return COLMAP's error text without the locations in its source code, in plain words.

    The text may repeat any content of a file at any length, so it is cleaned and shortened.
    """
    text = re.sub(r"\[\S+\.(cc|h):\d+\] *", "", one_line(error))
    text = re.sub(r"^Check failed: *", "COLMAP expected ", text)
    return as_plain(text if len(text) <= MAX_TOLD else text[:MAX_TOLD] + "...")


@dataclass(frozen=True)
class ColmapCovariance:
    """Covariances estimated by COLMAP, for image coordinates of standard deviation 1 px."""

    interior: tuple[FloatArray, ...]  # marginal, of the free parameters of each camera in order, (f, f)
    points: FloatArray  # with cameras and photographs held fixed (conditional), object unit^2, (n, 3, 3)


def covariance_with_colmap(
    network: Network, estimate: Estimate, *, gauge: str = "two_cameras"
) -> ColmapCovariance | None:
    """Return COLMAP's covariances at a solution; None for rigs, or if COLMAP finds the problem singular.

    COLMAP's covariance of a point is conditional on all photographs and cameras, and therefore too small by
    their contribution. Its covariance of the interior orientation is marginal and does not depend on the
    gauge.

    Args:
        network: photographs, points and image points.
        estimate: the solution, with cameras in a model that COLMAP has.
        gauge: two_cameras | control; COLMAP computes no covariance without a gauge.

    Raises:
        BackendError: as for `adjust_with_colmap`.
    """
    pycolmap = load_pycolmap()
    if estimate.mounts is not None:  # COLMAP 4.2 refuses photographs by cameras other than reference cameras
        return None
    options = ceres_options(pycolmap, colmap_free(estimate.cameras), len(network.images), 1, 1)
    with quiet(pycolmap):
        scene = reconstruction(pycolmap, network, estimate)
        config = adjustment_config(pycolmap, network, estimate, gauge)
        # estimate_ba_covariance requires this adjuster and no other; it need not have been run.
        adjuster = pycolmap.create_default_ceres_bundle_adjuster(options, config, scene)
        wanted = pycolmap.BACovarianceOptions()
        wanted.damping = 0.0
        covariances = pycolmap.estimate_ba_covariance(wanted, scene, adjuster)
        if covariances is None:
            return None
        interior = []
        for k, camera in enumerate(estimate.cameras):
            block = (
                covariances.get_other_params_cov(scene.camera(k + 1).params) if camera.free.any() else None
            )
            interior.append(np.zeros((0, 0)) if block is None else np.array(block))
        points = np.zeros((len(network.points), 3, 3))  # held points have none
        for j in range(len(network.points)):
            block = covariances.get_point_cov(j + 1)
            if block is not None:
                points[j] = block
    return ColmapCovariance(tuple(interior), points)


def adjust_with_covariance(network: Network, start: Estimate, *, threads: int = 1) -> ColmapAdjustment:
    """Adjust with COLMAP in a free datum, with its covariances of the points at the solution.

    Args, Raises: as `adjust_with_colmap`.
    """
    adjusted = adjust_with_colmap(network, start, threads=threads)
    covariance = covariance_with_colmap(network, adjusted.estimate)
    return replace(adjusted, point_covariance=None if covariance is None else covariance.points)


@dataclass(frozen=True)
class ColmapBackend:
    """COLMAP as the other adjuster of a validation (benchmarks.validation)."""

    name: str = "colmap"

    def adjust(self, network: Network, start: Estimate, *, control: bool) -> ColmapAdjustment:
        """Adjust with the control points held, or with a free datum."""
        return adjust_with_colmap(network, start, gauge="control" if control else "free")

    def covariance(self, network: Network, estimate: Estimate, *, control: bool) -> ColmapCovariance | None:
        """Return COLMAP's covariances at a solution."""
        return covariance_with_colmap(network, estimate, gauge="control" if control else "two_cameras")
