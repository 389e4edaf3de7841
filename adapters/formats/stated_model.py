"""A model as a file of another program states it: cameras, photographs, points, each of which may be missing.

A reader states what its file holds in its own numbering; `content_of` checks it and makes it a survey. All
formats thus refuse the same mistakes: names that are no names or leave their folder, mirrored rotations,
numbers of photographs, cameras or points that are not there, and image points that are no pixels.

Source: named in the module of each format.
"""

from __future__ import annotations

from array import array
from collections import Counter
from dataclasses import dataclass, field, replace
from pathlib import Path, PurePosixPath

import numpy as np
from scipy.spatial.transform import Rotation

from adapters.formats.cameras.lens_terms import is_rotation, nearest
from adapters.formats.content import UNSTATED, Content
from adapters.formats.control_tables import object_points
from adapters.reading.text_lines import MAX_IMAGE_POINTS, MAX_PHOTOGRAPHS, MAX_POINTS, Lines
from sfm.files.plain_text import MAX_NAME, MAX_SIDE_PX, is_name, shorten
from sfm.files.result_tables import refuse_moments
from sfm.model.camera import Camera, camera_from_values
from sfm.model.conventions import VISION_AXES, FloatArray, IntArray
from sfm.model.display import counted
from sfm.model.errors import SurveyFileError
from sfm.model.estimate import Estimate, Mounts
from sfm.model.network import ExteriorObservations, ImagePoints, Network, ScaleBars
from sfm.model.solution import Solution

NOMINAL_PX = (3600, 3600)  # of photographs whose size is not stated, with a larger side of 36 mm
NOMINAL_MM = 0.01


@dataclass
class StatedModel:
    """What a file of another program states of a model; lists may be empty, poses and points may be NaN."""

    path: Path
    cameras: list[Camera] = field(default_factory=list)
    images: list[str] = field(default_factory=list)  # m names of photographs
    camera: list[int] = field(default_factory=list)  # index of the camera of each photograph
    position: list[FloatArray] = field(default_factory=list)  # projection centres, (3,) each
    rotation: list[FloatArray] = field(default_factory=list)  # image axes (y up) to object axes, (3, 3) each
    points: list[str] = field(default_factory=list)  # n names of points
    xyz: array[float] = field(default_factory=lambda: array("d"))  # of all points one after another
    image: array[int] = field(default_factory=lambda: array("q"))  # photograph of each image point
    point: array[int] = field(default_factory=lambda: array("q"))  # point of each image point
    xy: array[float] = field(default_factory=lambda: array("d"))  # px in Kolinear's frame, one after another
    # places of cameras on rigs: R (3, 3) and t (3,), x = R x_rig + t in axes x right, y down, z forward
    places: dict[str, tuple[FloatArray, FloatArray]] = field(default_factory=dict)
    on_rig: dict[int, tuple[str, str]] = field(default_factory=dict)  # place and moment of photographs
    notes: list[str] = field(default_factory=list)  # on what is read but not used unchanged
    images_named: bool = True  # whether the photographs have names; else they are numbered
    points_named: bool = False  # likewise for the points
    # control and check points: coordinates (3,) and covariance (3, 3) by the index of the point
    control: dict[int, tuple[FloatArray, FloatArray]] = field(default_factory=dict)
    checks: dict[int, tuple[FloatArray, FloatArray]] = field(default_factory=dict)
    bars: list[tuple[int, int, float, float]] = field(default_factory=list)  # ends, length, sigma
    # observed poses: position (3,), omega phi kappa (3,), covariance (6, 6) by the index of the photograph
    exterior: dict[int, tuple[FloatArray, FloatArray, FloatArray]] = field(default_factory=dict)
    # of all points and image points, or empty; NaN where a point has none
    point_sigma: array[float] = field(default_factory=lambda: array("d"))  # of X, Y, Z one after another
    xy_sigma: array[float] = field(default_factory=lambda: array("d"))  # of x, y one after another, px
    used: list[bool] = field(default_factory=list)  # whether each image point took part; all if empty
    unit: str = ""  # object unit; empty where unknown
    crs: str = ""  # coordinate system of the object in well-known text; empty where unknown
    text: Lines | None = None  # the lines being read, for the place of an error

    def error(self, message: str) -> SurveyFileError:
        """Return an error in this file, at the line being read if it has lines."""
        if self.text is not None:
            return self.text.error(message)
        return SurveyFileError(f"{self.path}: {message}")

    def add_image(
        self, name: str, camera: int, position: FloatArray | None = None, rotation: FloatArray | None = None
    ) -> None:
        """Add a photograph.

        Args:
            name: its name, a path below the folder of the photographs.
            camera: index of its camera.
            position: projection centre, (3,); None without orientation.
            rotation: image axes (x right, y up, looking along -z) to object axes, (3, 3).

        Raises:
            SurveyFileError: no name, one photograph too many, or a matrix that is no rotation.
        """
        if len(self.images) == MAX_PHOTOGRAPHS:
            raise self.error(f"more than {MAX_PHOTOGRAPHS} photographs, no more are read")
        if not is_name(name):
            raise self.error(
                f"the name of a photograph is '{shorten(name)}', needed plain text of 1 to {MAX_NAME} "
                "characters"
            )
        if position is None or rotation is None:
            position, rotation = np.full(3, np.nan), np.full((3, 3), np.nan)
        elif not is_rotation(rotation):
            raise self.error(f"photograph {shorten(name)}: its matrix is no rotation, or a reflection")
        else:
            rotation = (
                rotation if np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-14) else nearest(rotation)
            )
        self.images.append(name)
        self.camera.append(camera)
        self.position.append(position)
        self.rotation.append(rotation)

    def add_point(self, name: str, xyz: FloatArray | list[float]) -> int:
        """Add a point and return its index.

        Raises:
            SurveyFileError: one point too many.
        """
        if len(self.points) == MAX_POINTS:
            raise self.error(f"more than {MAX_POINTS} points, no more are read")
        self.points.append(name)
        self.xyz.extend(xyz)
        return len(self.points) - 1

    def add_image_point(self, image: int, point: int, x: float, y: float) -> None:
        """Add an image point, px in Kolinear's frame.

        Raises:
            SurveyFileError: one image point too many, or beyond the largest photographs.
        """
        if len(self.image) == MAX_IMAGE_POINTS:
            raise self.error(f"more than {MAX_IMAGE_POINTS} image points, no more are read")
        if abs(x) > MAX_SIDE_PX or abs(y) > MAX_SIDE_PX:
            raise self.error(
                f"photograph {shorten(self.images[image])}: an image point at ({x:g}, {y:g}) px, needed "
                f"coordinates of at most {MAX_SIDE_PX}"
            )
        self.image.append(image)
        self.point.append(point)
        self.xy.extend((x, y))


def content_of(stated: StatedModel) -> Content:
    """Return a stated model as a survey; points that its program only numbers are uncoded.

    The same point twice in one photograph is read once, as the first of both, and noted. Places that share
    photographs of one moment make a rig. A camera at several places becomes one at each, with the same
    interior orientation.

    Raises:
        SurveyFileError: two photographs or points have one name, a name leaves the folder of the photographs,
            two photographs are of one place and moment, or nothing is in the file.
    """
    images = _names_below(stated)
    for what, names in (("photograph", images), ("point", stated.points)):
        for name, count in Counter(names).most_common(1):
            if count > 1:
                raise stated.error(f"{counted(count, what)} with the name '{shorten(name)}', needed one")
    if not (stated.cameras or stated.points):
        raise stated.error("neither a camera nor a point is in it")
    image, point = np.array(stated.image, dtype=np.int64), np.array(stated.point, dtype=np.int64)
    _, first = np.unique(image * max(len(stated.points), 1) + point, return_index=True)
    first.sort()
    notes = list(stated.notes)
    if len(first) < len(image):
        notes.append(
            f"{counted(len(image) - len(first), 'image point')} of points that their photograph shows twice "
            "left out"
        )
    xy = np.array(stated.xy, dtype=float).reshape(-1, 2)
    sigma = (
        np.array(stated.xy_sigma, dtype=float).reshape(-1, 2) if stated.xy_sigma else np.ones((len(xy), 2))
    )
    seen = ImagePoints(
        image, point, xy, np.eye(2) * sigma[:, None] ** 2, np.full(len(xy), bool(stated.xy_sigma))
    )
    used = np.array(stated.used or [True] * len(xy), dtype=bool)[first]
    images_given, poses = list(stated.exterior), list(stated.exterior.values())
    bars = np.array(stated.bars, dtype=float).reshape(-1, 4)
    network = Network(
        images,
        np.array(stated.camera, dtype=np.int64),
        tuple(stated.points),
        seen.select(first[used]),
    ).with_given(
        object_points(stated.control),
        ExteriorObservations(
            np.array(images_given, dtype=np.int64),
            np.array([position for position, _, _ in poses], dtype=float).reshape(-1, 3),
            np.array([angles for _, angles, _ in poses], dtype=float).reshape(-1, 3),
            np.array([C for _, _, C in poses], dtype=float).reshape(-1, 6, 6),
        ),
        ScaleBars(bars[:, 0].astype(np.int64), bars[:, 1].astype(np.int64), bars[:, 2], bars[:, 3]),
    )
    estimate = Estimate(
        tuple(stated.cameras),
        np.array(stated.position, dtype=float).reshape(-1, 3),
        np.array(stated.rotation, dtype=float).reshape(-1, 3, 3),
        np.array(stated.xyz, dtype=float).reshape(-1, 3),
    )
    network, estimate = _with_rigs(stated, network, estimate)
    variance = np.array(stated.point_sigma, dtype=float).reshape(-1, 1, 3) ** 2
    solution = Solution(
        stated.path.name,
        network,
        estimate,
        np.where(np.eye(3, dtype=bool), variance, 0.0) if np.isfinite(variance).any() else None,
        unit=stated.unit,
        points_named=stated.points_named,
        images_named=stated.images_named,
    )
    return Content(
        solution,
        rejected=seen.select(first[~used]),
        checks=object_points(stated.checks),
        notes=tuple(notes),
        crs=stated.crs,
    )


def _with_rigs(stated: StatedModel, network: Network, estimate: Estimate) -> tuple[Network, Estimate]:
    """Return the network and estimate with the rigs of a stated model."""
    rigs = _joined_places(stated)
    if not rigs:
        return network, estimate
    rig_of = {place: rig for rig, places in enumerate(rigs) for place in places}
    place_of = {i: place for i, (place, _) in stated.on_rig.items() if place in rig_of}  # by photograph
    # a camera for each place of one of the file, in its order; "" off the rigs
    lens_and_place = [(a, place_of.get(i, "")) for i, a in enumerate(stated.camera)]
    idle = [(a, "") for a in range(len(stated.cameras)) if a not in stated.camera]
    order = {place: k for k, place in enumerate(stated.places)}
    keys = sorted({*lens_and_place, *idle}, key=lambda key: (key[0], order.get(key[1], -1)))
    number, parts = {key: k for k, key in enumerate(keys)}, Counter(a for a, _ in keys)
    cameras = []
    for a, place in keys:
        camera = stated.cameras[a]
        if parts[a] > 1:  # at several places, which share its interior orientation
            shared = (camera.name,) * len(camera.names)
            camera = replace(camera, name=f"{camera.name} {place}".strip(), shared=shared)
        cameras.append(camera)
    mounts = _mounts(stated, [place for _, place in keys], rig_of)
    when: list[object] = [
        (rig_of[place_of[i]], stated.on_rig[i][1]) if i in place_of else i for i in range(len(stated.images))
    ]
    moments = {key: t for t, key in enumerate(dict.fromkeys(when))}
    moment = np.array([moments[key] for key in when], dtype=np.int64)
    network = replace(network, camera=np.array([number[key] for key in lens_and_place], dtype=np.int64))
    refuse_moments(f"{stated.path}: rigs", [camera.name for camera in cameras], network, mounts, moment)
    return replace(network, moment=moment), replace(estimate, cameras=tuple(cameras), mounts=mounts)


def _mounts(stated: StatedModel, places: list[str], rig_of: dict[str, int]) -> Mounts:
    """Return the mounts of cameras at some places, "" off the rigs; a rig has the axes of its first place."""
    position, rotation = np.zeros((len(places), 3)), np.tile(np.eye(3), (len(places), 1, 1))
    free = np.zeros((len(places), 6), dtype=bool)
    reference: dict[int, str] = {}
    for place in stated.places:
        if place in rig_of:
            reference.setdefault(rig_of[place], place)
    for k, place in enumerate(places):
        if place and place != reference[rig_of[place]]:
            (R0, t0), (R, t) = stated.places[reference[rig_of[place]]], stated.places[place]
            R = R @ R0.T
            rotation[k] = VISION_AXES @ R.T @ VISION_AXES
            position[k], free[k] = -VISION_AXES @ R.T @ (t - R @ t0), True
    names = tuple(f"rig {rig_of[place] + 1}" if place else "" for place in places)
    return Mounts(position, rotation, free, names)


def _joined_places(stated: StatedModel) -> list[set[str]]:
    """Return the places of each rig: those that photographs of one moment join."""
    at: dict[str, set[str]] = {}
    for place, moment in stated.on_rig.values():
        at.setdefault(moment, set()).add(place)
    rigs = list[set[str]]()
    for places in at.values():
        if len(places) > 1:
            joined = [rig for rig in rigs if rig & places]
            rigs = [rig for rig in rigs if not rig & places] + [places.union(*joined)]
    order = {place: k for k, place in enumerate(stated.places)}
    return sorted(rigs, key=lambda rig: min(order[place] for place in rig))


def file_in(folder: Path, *names: str) -> Path | None:
    """Return the first of some files that is in a folder or its subfolders; None if none is.

    Raises:
        SurveyFileError: it is a link that leaves the folder.
    """
    for name in names:
        path = folder / name
        if path.is_file():
            if not path.resolve().is_relative_to(folder.resolve()):
                raise SurveyFileError(
                    f"{path}: a link that leaves its folder; the file itself is needed there"
                )
            return path
    return None


@dataclass(frozen=True)
class Frame:
    """A moment of a rig."""

    pose: tuple[FloatArray, FloatArray]  # R (3, 3) and t (3,), x_rig = R X + t, x right, y down, z forward
    photographs: list[int]


def rigs_of(
    network: Network, estimate: Estimate
) -> tuple[dict[int, tuple[FloatArray, FloatArray]], dict[int, Frame]]:
    """Return the places of the cameras on rigs by their indices, and the moments of these rigs by number.

    A place is R (3, 3) and t (3,), x = R x_rig + t in axes x right, y down, z forward; a rig has the axes of
    its reference camera.
    """
    mounts = estimate.mounts
    if mounts is None or network.moment is None:
        return {}, {}
    places = {}
    for a, rig in enumerate(mounts.rig):
        if rig:
            R = VISION_AXES @ mounts.rotation[a].T @ VISION_AXES
            places[a] = (R, -R @ VISION_AXES @ mounts.position[a])
    frames: dict[int, Frame] = {}
    rotation = to_vision_axes(estimate.rotation)
    for i, (t, a) in enumerate(zip(network.moment.tolist(), network.camera.tolist(), strict=True)):
        if a not in places:
            continue
        if t not in frames:
            R, shift = places[a]
            frames[t] = Frame((R.T @ rotation[i], R.T @ (-rotation[i] @ estimate.position[i] - shift)), [])
        frames[t].photographs.append(i)
    return places, frames


def from_vision_axes(R: FloatArray) -> FloatArray:
    """Return rotations from image to object axes of those from object axes to x right, y down, z forward.

    Args:
        R: rotations of computer vision, object to camera axes, (..., 3, 3).
    """
    return np.asarray(np.swapaxes(R, -1, -2) @ VISION_AXES)


def to_vision_axes(rotation: FloatArray) -> FloatArray:
    """Return the inverse of `from_vision_axes`, (..., 3, 3)."""
    return np.asarray(VISION_AXES @ np.swapaxes(rotation, -1, -2))


def rotation_from_heading(heading: float, pitch: float, roll: float) -> FloatArray:
    """Return R = Rz(-heading) Rx(pitch) Ry(roll), image axes to object axes, (3, 3).

    With angles of 0 the camera looks down with north at the top; the heading, also called yaw, is clockwise.

    Args:
        heading: angle, degrees.
        pitch: angle, degrees.
        roll: angle, degrees.
    """
    return np.asarray(Rotation.from_euler("ZXY", [-heading, pitch, roll], degrees=True).as_matrix())


def heading_from_rotation(rotation: FloatArray) -> FloatArray:
    """Return heading, pitch and roll of `rotation_from_heading`, degrees, (..., 3).

    At a pitch of +-90 degrees heading and roll are not separable, and roll is 0.

    Args:
        rotation: image axes to object axes, (..., 3, 3).
    """
    R = np.asarray(rotation, dtype=float)
    across = np.hypot(R[..., 2, 0], R[..., 2, 2])
    level = across > 1e-12  # rounding of a rotation below it
    heading = np.where(level, np.arctan2(R[..., 0, 1], R[..., 1, 1]), -np.arctan2(R[..., 1, 0], R[..., 0, 0]))
    roll = np.where(level, np.arctan2(-R[..., 2, 0], R[..., 2, 2]), 0.0)
    return np.asarray(np.degrees(np.stack([heading, np.arctan2(R[..., 2, 1], across), roll], axis=-1)))


def unstated_camera(stated: StatedModel) -> Camera:
    """Return the camera that stands for one that a file does not state, and note it."""
    stated.notes.append(
        "cameras are not stated: one of c 36 mm with photographs of 36 mm x 36 mm stands for them"
    )
    return camera_from_values(UNSTATED, "brown_forward", NOMINAL_PX, (NOMINAL_MM, NOMINAL_MM), c_mm=36.0)


def numbers_of_slots(index: IntArray) -> IntArray:
    """Return the number of each image point among those of its photograph, from 0, (k,)."""
    order = np.argsort(index, kind="stable")
    ordered = index[order]
    starts = np.flatnonzero(np.concatenate([[True], ordered[1:] != ordered[:-1]])) if len(index) else ordered
    slot = np.empty(len(index), dtype=np.int64)
    slot[order] = np.arange(len(index)) - np.repeat(starts, np.diff(np.append(starts, len(index))))
    return slot


def nominal_size(xy: FloatArray) -> tuple[int, int]:
    """Return width and height of the smallest photograph with its origin in the middle that has all points.

    Args:
        xy: image points from the middle, px, (k, 2).
    """
    half = np.abs(xy).max(axis=0) if len(xy) else np.zeros(2)
    width, height = (2 * int(np.ceil(side + 1)) for side in half)
    return width, height


def _names_below(stated: StatedModel) -> tuple[str, ...]:
    """Return the names of photographs as paths below a folder, the common one of absolute paths."""
    paths = [PurePosixPath(name.replace("\\", "/")) for name in stated.images]
    for name, path in zip(stated.images, paths, strict=True):
        if ".." in path.parts or not path.name:
            raise stated.error(
                f"photograph '{shorten(name)}': a path that leaves the folder of the photographs"
            )
    absolute = [path.is_absolute() or ":" in path.parts[0] for path in paths]
    if not any(absolute):
        return tuple(stated.images)
    folders = [path.parts[:-1] for path, on in zip(paths, absolute, strict=True) if on]
    common = 0
    for parts in zip(*folders, strict=False):
        if len(set(parts)) > 1:
            break
        common += 1
    return tuple(
        "/".join(path.parts[common:]) if on else name
        for name, path, on in zip(stated.images, paths, absolute, strict=True)
    )
