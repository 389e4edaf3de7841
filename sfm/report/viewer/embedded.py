"""The viewer embedded in a page, and the scenes of solutions.

A scene is embedded in a page as text: names as JSON and numbers as arrays, compressed by gzip, as base64.

    4 bytes     length of the header, little-endian
    header      JSON in UTF-8, padded with spaces to a multiple of 8 bytes
    arrays      one after another, each starting at a multiple of 8 bytes

The header describes each array as [type, first byte, number of values]. viewer/src/data.js reads it.

Source: RFC 1952 (gzip), RFC 4648 (base64).
"""

from __future__ import annotations

import base64
import gzip
import json
from dataclasses import dataclass, replace
from functools import cache
from importlib.resources import files
from typing import Any

import numpy as np
from markupsafe import Markup

from sfm.files.plain_text import or_none
from sfm.judgement.survey_result import sort_likeliest_first
from sfm.model.conventions import AnyArray, BoolArray, FloatArray, IntArray, angles_from_rotation
from sfm.model.network import ScaleBars, rows_of
from sfm.model.solution import MAX_POINTS, SeenTargets, Solution
from sfm.orientation.image_rays import image_residuals, ray_angles
from sfm.report.figures.overlays import nearest_image_points
from sfm.report.findings import Findings
from sfm.report.network_geometry import rms_of_groups
from sfm.report.phrases import finer_unit
from sfm.report.viewer.pictures import (
    COLUMNS,
    CROP_PX,
    Bar,
    Marks,
    Pictures,
    Rays,
    ViewerScene,
    distance_sigmas,
)

UNUSED = "measured, not part of the result"
ALIGNED = 8  # bytes to which arrays are aligned
TYPES = {"f8": "<f8", "f4": "<f4", "u4": "<u4", "u1": "|u1"}
NO_CROP = "no picture in this page or beside it"
NO_FILE = "the picture is in the folder of the report, which is not beside this page"
NO_PICTURE = "no photograph was read for this page"


@dataclass(frozen=True)
class Viewer:
    """The parts of a viewer that a page embeds."""

    script: Markup  # exact text, since the policy allows it by its hash
    style: Markup
    data: str  # base64
    pictures: str  # base64
    notes: tuple[str, ...]  # what the page omits


def viewer_of(scene: ViewerScene, pictures: Pictures) -> Viewer:
    """Return the viewer of a scene."""
    script, style = sources()
    notes = (*scene.notes, *pictures.notes)
    return Viewer(Markup(script), Markup(style), packed_scene(scene, pictures), pictures.base64, notes)


@cache
def sources() -> tuple[str, str]:
    """Return script and style sheet of the viewer."""
    folder = files("sfm.report.viewer")
    script = folder.joinpath("viewer.js").read_text(encoding="utf-8")
    return script, folder.joinpath("viewer.css").read_text(encoding="utf-8")


def packed_scene(scene: ViewerScene, pictures: Pictures) -> str:
    """Return a scene as base64 text for an element of a page."""
    upper = np.triu_indices(3)
    rays, marks = scene.rays, scene.marks
    arrays: dict[str, tuple[str, AnyArray]] = {
        "point.xyz": ("f8", scene.xyz),
        "point.covariance": ("f4", scene.covariance[:, upper[0], upper[1]]),
        "point.rays": ("u4", scene.rays_of_point),
        "point.angle": ("f4", scene.angle_deg),
        "point.rms": ("f4", scene.point_rms_px),
        "photo.camera": ("u4", scene.camera),
        "photo.position": ("f8", scene.position),
        "photo.rotation": ("f8", scene.rotation),
        "photo.angles": ("f8", np.degrees(angles_from_rotation(scene.rotation))),
        "photo.sigma": ("f4", scene.exterior_sigma),
        "photo.rms": ("f4", scene.photo_rms_px),
        "photo.points": ("u4", scene.points_of_photo),
        "ray.point": ("u4", rays.point),
        "ray.photo": ("u4", rays.photo),
        "ray.xy": ("f4", rays.xy),
        "ray.v": ("f4", rays.v),
        "ray.w": ("f4", rays.w),
        "ray.rejected": ("u1", rays.rejected),
        "ray.ellipse": ("f4", rays.ellipse),
        "mark.photo": ("u4", marks.photo),
        "mark.xy": ("f4", marks.xy),
        "mark.reason": ("u4", marks.reason),
        **pictures.arrays(),
    }
    if scene.distance_sigma is not None:
        arrays["pair.sigma"] = ("f4", scene.distance_sigma)
    if scene.displacement is not None:
        states = sorted(set(scene.state))
        arrays["point.displacement"] = ("f4", scene.displacement)
        arrays["point.state"] = ("u1", np.array([states.index(state) for state in scene.state]))
    if scene.colour is not None:
        arrays["point.colour"] = ("u1", scene.colour)
    if scene.deviation is not None:
        arrays["point.deviation"] = ("f4", scene.deviation)
    return _packed(_header(scene, pictures), arrays)


def _header(scene: ViewerScene, pictures: Pictures) -> dict[str, Any]:
    variance = np.trace(scene.covariance, axis1=1, axis2=2) / 3
    known = variance[variance > 0]
    factor, unit = finer_unit(scene.unit, float(np.sqrt(np.median(known))) if len(known) else np.nan)
    return {
        "name": scene.name,
        "unit": scene.unit,
        "fine": {"factor": factor, "unit": unit},
        "points": scene.points,
        "photographs": scene.photographs,
        "cameras": [
            {
                "name": camera.name,
                "width": camera.size_px[0],
                "height": camera.size_px[1],
                "c_px": camera.c_px,
            }
            for camera in scene.cameras
        ],
        "reasons": scene.marks.reasons,
        "bars": [
            {
                "from": bar.start,
                "to": bar.end,
                "length": or_none(bar.length),
                "sigma": or_none(bar.sigma),
                "difference": or_none(bar.difference),
            }
            for bar in scene.bars
        ],
        "control": scene.control,
        "states": sorted(set(scene.state)),
        "rms_px": scene.rms_px if np.isfinite(scene.rms_px) else 0,
        "crop_px": CROP_PX,
        "crop_columns": COLUMNS,
        "files": pictures.files,
        "crop_files": pictures.crop_files,
        "notes": {
            "page": [*scene.notes, *pictures.notes],
            "no_crop": NO_CROP if pictures.count else NO_PICTURE,
            "no_file": NO_FILE,
            "no_picture": NO_PICTURE,
            "covariance": "their correlation is not stored"
            + (f" for more than {MAX_POINTS} points." if len(scene.points) > MAX_POINTS else "."),
        },
    }


def _packed(header: dict[str, Any], arrays: dict[str, tuple[str, AnyArray]]) -> str:
    entries: dict[str, tuple[str, int, int]] = {}
    parts: list[bytes] = []
    at = 0
    for name, (kind, values) in arrays.items():
        array = np.ascontiguousarray(values, dtype=TYPES[kind])
        entries[name] = (kind, at, array.size)
        raw = array.tobytes()
        raw += bytes(-len(raw) % ALIGNED)
        parts.append(raw)
        at += len(raw)
    body = b"".join(parts)

    def head(start: int) -> bytes:
        moved = {name: [kind, start + first, count] for name, (kind, first, count) in entries.items()}
        text = json.dumps({**header, "arrays": moved}, ensure_ascii=False, allow_nan=False).encode()
        return text + b" " * (-(4 + len(text)) % ALIGNED)

    start = 4 + len(head(0))
    while 4 + len(head(start)) != start:  # digits of the offsets may lengthen the header
        start = 4 + len(head(start))
    text = head(start)
    data = len(text).to_bytes(4, "little") + text + body
    return base64.b64encode(gzip.compress(data, compresslevel=6, mtime=0)).decode()


def scene_of_result(findings: Findings, colours: AnyArray | None = None) -> ViewerScene:
    """Return the scene of a survey, with the measured and rejected candidates in its photographs.

    colours: red, green and blue of the points in the photographs, uint8, (n, 3); None if unknown.
    """
    result, a = findings.result, findings.result.adjustment
    names, check = a.network.points, result.control_check
    scene = scene_of_stored(
        replace(result.solution.with_joint_covariance, network=a.network),
        w=a.standardised if len(a.standardised) == len(a.rejected) else None,
        rejected=a.rejected,
        seen_targets=result.seen_targets,
        residuals=a.residuals,
    )
    checked = () if check is None else tuple(names.index(name) for name in check.points if name in names)
    return replace(
        scene,
        exterior_sigma=findings.precision.exterior_deg,
        control=scene.control or checked,
        colour=None if colours is None else colours[a.estimate.determined],
    )


def scene_of_stored(
    stored: Solution,
    *,
    w: FloatArray | None = None,
    rejected: BoolArray | None = None,
    seen_targets: SeenTargets | None = None,
    residuals: FloatArray | None = None,
) -> ViewerScene:
    """Return the scene of a stored result, without photographs and points that have no coordinates.

    Args:
        stored: the result, including rejected image points if `rejected` marks them.
        w: Baarda's w of its image points, if known, (k, 2).
        rejected: which of its image points took no part; None for none, (k,).
        seen_targets: outlines of its targets and other candidates in its photographs, if known.
        residuals: computed minus measured, px, (k, 2); None to compute them by projection.
    """
    network, estimate = stored.network, stored.estimate
    seen = network.image_points
    oriented, determined = np.flatnonzero(estimate.oriented), np.flatnonzero(estimate.determined)
    rejected = np.zeros(len(seen), dtype=bool) if rejected is None else rejected
    w = np.full((len(seen), 2), np.nan) if w is None else w
    kept = np.flatnonzero(estimate.oriented[seen.image] & estimate.determined[seen.point])
    kept = kept[np.lexsort((seen.image[kept], seen.point[kept]))]
    v = (image_residuals(network, estimate) if residuals is None else residuals)[kept]
    point = np.searchsorted(determined, seen.point[kept])
    photo = np.searchsorted(oriented, seen.image[kept])
    used = ~rejected[kept]
    ellipse, marks = np.full((len(kept), 3), np.nan), Marks.none()
    if seen_targets is not None:
        rows = np.flatnonzero(estimate.oriented[seen_targets.image])
        of_oriented = SeenTargets(  # photographs, numbered without the others
            np.searchsorted(np.flatnonzero(estimate.oriented), seen_targets.image[rows]),
            seen_targets.xy[rows],
            seen_targets.ellipse[rows],
            tuple(seen_targets.reason[k] for k in rows),
        )
        ellipse, marks = joined_targets(of_oriented, photo, seen.xy[kept])
    rays = Rays(point, photo, seen.xy[kept], v, w[kept], ~used, ellipse)
    use = np.zeros(len(seen), dtype=bool)
    use[kept[used]] = True
    n, m = len(determined), len(oriented)
    xyz = estimate.points[determined]
    covariance = np.full((n, 3, 3), np.nan)
    if stored.point_covariance is not None:
        covariance = stored.point_covariance[determined]
    sigma = np.full((m, 6), np.nan)
    if stored.position_covariance is not None:
        sigma[:, :3] = np.sqrt(np.diagonal(stored.position_covariance[oriented], axis1=1, axis2=2))
    joint = stored.covariance
    if stored.covariance_points is not None or n < len(network.points):
        joint = None  # of other points
    index = {int(j): k for k, j in enumerate(determined)}
    notes = []
    for kind, placed, names in (
        ("photographs", oriented, network.images),
        ("points", determined, network.points),
    ):
        if len(placed) < len(names):
            notes.append(f"{len(names) - len(placed)} of {len(names)} {kind} have no coordinates: omitted.")
    return ViewerScene(
        stored.name,
        stored.unit or "object units",
        estimate.cameras,
        tuple(network.points[j] for j in determined),
        xyz,
        covariance,
        np.bincount(point[used], minlength=n),
        ray_angles(network, estimate, use)[determined],
        rms_of_groups(point[used], v[used], n),
        tuple(network.images[i] for i in oriented),
        network.camera[oriented],
        estimate.position[oriented],
        estimate.rotation[oriented],
        sigma,
        rms_of_groups(photo[used], v[used], m),
        np.bincount(photo[used], minlength=m),
        rays,
        marks,
        _bars(network.scale_bars, xyz, index),
        tuple(index[int(j)] for j in network.control.point if int(j) in index),
        None if joint is None else distance_sigmas(xyz, joint),
        float(np.sqrt(np.nanmean(v[used] ** 2))) if used.any() else np.nan,
        tuple(notes),
    )


def _bars(bars: ScaleBars, xyz: FloatArray, index: dict[int, int]) -> tuple[Bar, ...]:
    """Return the scale bars between points of a scene, each with its adjusted minus its given length."""
    shown = []
    for i, j, length, sigma in zip(
        bars.start.tolist(), bars.end.tolist(), bars.length.tolist(), bars.sigma.tolist(), strict=True
    ):
        if i in index and j in index:
            start, end = index[i], index[j]
            shown.append(
                Bar(start, end, length, sigma, float(np.linalg.norm(xyz[start] - xyz[end])) - length)
            )
    return tuple(shown)


def joined_targets(seen: SeenTargets, image: IntArray, xy: FloatArray) -> tuple[FloatArray, Marks]:
    """Return the ellipse of each image point, NaN without one, (k, 3), and the other candidates.

    Args:
        seen: targets and candidates in the same photographs.
        image: photograph of each image point, (k,).
        xy: position of each image point, px, (k, 2).
    """
    ellipse = np.full((len(xy), 3), np.nan)
    left = np.ones(len(seen.image), dtype=bool)
    of_targets = np.flatnonzero(seen.measured)
    count = 1 + int(max(seen.image.max(initial=-1), image.max(initial=-1)))
    by_photograph = zip(rows_of(image, count), rows_of(seen.image[of_targets], count), strict=True)
    for rows, at in by_photograph:
        measured = of_targets[at]
        used = nearest_image_points(seen.xy[measured], xy[rows])
        ellipse[rows[used[used >= 0]]] = seen.ellipse[measured[used >= 0]]
        left[measured[used >= 0]] = False
    kept = np.flatnonzero(left)
    kept = kept[np.argsort(seen.image[kept], kind="stable")]
    words = [seen.reason[k] or UNUSED for k in kept.tolist()]
    reasons = {word: number for number, word in enumerate(sort_likeliest_first(set(words)))}
    number = np.array([reasons[word] for word in words], dtype=np.int64)
    return ellipse, Marks(seen.image[kept], seen.xy[kept], number, tuple(reasons))
