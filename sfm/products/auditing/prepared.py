"""A model of another program as an audit takes it: what its file leaves out, and as few cameras as it has.

Some formats store image points and orientations, and no object points; others one principal distance, which a
model with two would free twice.

Source: Foerstner and Wrobel (2016), Photogrammetric Computer Vision, sec. 13.4 (intersection).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from sfm.model.camera import Camera
from sfm.model.display import counted
from sfm.model.distortion.models import MODELS
from sfm.model.solution import Solution
from sfm.orientation.image_rays import intersect_image_points
from sfm.products.refining.joined_cameras import join_cameras

# models with one principal distance, and the parameters of `opencv` that each has besides fx, cx, cy
ONE_FOCAL = {"simple_pinhole": {}, "simple_radial": {"k": "k1"}, "radial": {"k1": "k1", "k2": "k2"}}


def prepared_model(model: Solution, *, one_camera: bool) -> tuple[Solution, tuple[str, ...]]:
    """Return a model with the points that its file leaves out, and its cameras with their own parameters.

    Args:
        model: the model as it was read.
        one_camera: whether to join cameras of one size and lens model.

    Returns:
        The model, and notes on what was added to it.

    Raises:
        GeometryError: cameras are to be joined, and no two could be one.
    """
    network, estimate = model.network, model.estimate
    notes = []
    if one_camera:
        before = len(estimate.cameras)
        network, estimate, _ = join_cameras(network, estimate)
        notes.append(f"{counted(before, 'camera')} joined into {len(estimate.cameras)}, as --one-camera asks")
    seen = network.image_points
    rows = seen.select(estimate.oriented[seen.image] & ~estimate.determined[seen.point])
    if len(rows):
        met = intersect_image_points(
            rows, network.camera, estimate, n_points=len(network.points), tolerance_px=np.inf
        )
        points = np.where(estimate.determined[:, None], estimate.points, met.points)
        count = int((np.isfinite(points).all(axis=1) & ~estimate.determined).sum())
        estimate = replace(estimate, points=points)
        if count:
            notes.append(
                f"the model has no coordinates of {counted(count, 'point')}, which were intersected from its "
                "photographs"
            )
    estimate = replace(estimate, cameras=_with_one_focal(estimate.cameras))
    return replace(model, network=network, estimate=estimate), tuple(notes)


def _with_one_focal(cameras: Sequence[Camera]) -> tuple[Camera, ...]:
    """Return cameras of `opencv` that come from a model with one principal distance in that model."""
    of_one, needed = [], set[str]()
    for camera in cameras:
        parameters = dict(zip(camera.names, camera.parameters.tolist(), strict=True))
        single = camera.model == "opencv" and parameters["fx"] == parameters["fy"]
        single = single and not (parameters["p1"] or parameters["p2"])
        of_one.append(single)
        if single:
            needed |= {name for name in ("k1", "k2") if parameters[name]}
    name = next(name for name, terms in ONE_FOCAL.items() if needed <= set(terms.values()))
    source = {"f": "fx", "cx": "cx", "cy": "cy"} | ONE_FOCAL[name]
    plain = []
    for camera, single in zip(cameras, of_one, strict=True):
        if single:
            rows = [camera.names.index(source[parameter]) for parameter in MODELS[name].names]
            camera = replace(
                camera, model=name, parameters=camera.parameters[rows], free=camera.free[rows], shared=()
            )
        plain.append(camera)
    return tuple(plain)
