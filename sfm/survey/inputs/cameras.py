"""The cameras of a survey: their start values, and their interior orientation in the final adjustment.

Approximate values are found with one interior orientation for each camera of the survey file. In it, observed
parameters keep their observed values. The final adjustment may have a common interior orientation for all
photographs of a camera, or one for groups of photographs, or one for each photograph (image-variant). Its
parameters may be observed.

Source: Luhmann et al., Close-Range Photogrammetry and 3D Imaging (2020), sec. 4.4.2 (image-variant
interior orientation).
"""

from __future__ import annotations

import fnmatch
from collections.abc import Iterable, Sequence
from dataclasses import replace

import numpy as np

from sfm.files.globs import name_of_glob
from sfm.model.camera import Camera, base_name, camera_from_values
from sfm.model.conventions import FloatArray, IntArray
from sfm.model.display import counted, listed
from sfm.model.distortion.brown import from_balanced
from sfm.model.distortion.models import MODELS
from sfm.model.errors import PhotographError, SurveyFileError
from sfm.model.estimate import Estimate
from sfm.model.network import InteriorObservations, Network, rows_of
from sfm.model.observations.pose import MountObservations
from sfm.photographs.exif import Metadata
from sfm.survey.inputs.given_values import StartCameras
from sfm.survey.inputs.settings import CameraSettings

MIN_EIGENVALUE = 1e-12  # a matrix with a smaller eigenvalue is not a correlation matrix
MAX_PIXEL_MM = 1000.0  # side of a pixel; it is 1 mm in models without a pixel size
MIN_VIEW_DEG, MAX_VIEW_DEG = (
    0.5,
    170.0,
)  # diagonal field of view of a central projection; lenses have 1 to 140
COMMON_VIEW_DEG = 10.0, 120.0  # of nearly all cameras, used to guess a wrong unit
MAX_SHOWN = 10  # cameras, and globs of a camera, in a message
MAX_PIXEL_RATIO = 10.0  # of the sides of a pixel; anamorphic lenses and line scanners stay below 3


def camera_of_images(cameras: Sequence[CameraSettings], images: Sequence[str], source: str) -> list[int]:
    """Return the index of the camera of each photograph, by the globs and names of the cameras.

    Args:
        cameras: cameras of the survey.
        images: names of the photographs.
        source: name of the survey in error messages.

    Raises:
        SurveyFileError: the globs and names of no camera match, or those of several cameras.
    """
    matches = cameras_of_images(cameras, images)
    for image, of_image in zip(images, matches, strict=True):
        if len(of_image) != 1:
            globs = (f"{c.name} {listed(map(repr, c.images or ()), most=MAX_SHOWN)}" for c in cameras)
            many = "no camera" if not of_image else f"{counted(len(of_image), 'camera')}"
            raise SurveyFileError(
                f"{source}: image '{image}' matches the glob of {many}: {listed(globs, most=MAX_SHOWN)}"
            )
    return [of_image[0] for of_image in matches]


def cameras_of_images(cameras: Sequence[CameraSettings], images: Iterable[str]) -> list[list[int]]:
    """Return for each photograph the indices of the cameras whose globs or names match its name.

    Args:
        cameras: cameras of the survey; a single one without globs has all photographs.
        images: names of the photographs.
    """
    if len(cameras) == 1 and cameras[0].images is None:
        return [[0] for _ in images]
    by_name: dict[str, list[int]] = {}
    globs = list[tuple[int, str]]()
    for index, camera in enumerate(cameras):
        for pattern in camera.images or ():
            name = name_of_glob(pattern)
            if name is None:
                globs.append((index, pattern))
            else:
                by_name.setdefault(name, []).append(index)
    return [
        sorted({*by_name.get(image, ()), *(k for k, glob in globs if fnmatch.fnmatchcase(image, glob))})
        for image in images
    ]


def start_cameras(
    settings: Sequence[CameraSettings],
    source: str,
    metadata: tuple[Metadata, ...] = (),
    camera: IntArray | None = None,
    names: tuple[str, ...] = (),
    given: StartCameras | None = None,
) -> tuple[Camera, ...]:
    """Return the cameras with their start values, in the order of the survey file.

    Args:
        settings: cameras of the survey; the photographs give missing values.
        source: name of the survey in error messages.
        metadata: size and EXIF data of the readable photographs, (m,); empty with [observations].
        camera: camera index of each photograph, (m,).
        names: names of the photographs, (m,).
        given: values of [approximate]; see `approximate_values`.

    Raises:
        PhotographError: photographs of one camera differ in size from one another or from size_px.
        SurveyFileError: size, pixel size or principal distance is unknown, or they give a field of view that
            no lens has.
    """
    index = np.zeros(0, dtype=np.int64) if camera is None else camera
    cameras = []
    for stated, photographs in zip(settings, rows_of(index[: len(metadata)], len(settings)), strict=True):
        size = _common_size(stated, [(names[k], metadata[k].size_px) for k in photographs])
        where = f"{source}: camera {stated.name}"
        if size is None:
            raise SurveyFileError(f"{where}: size_px = [width, height] is needed, there is no photograph")
        pixel, focal = stated.pixel_mm, stated.c_mm
        if stated.sensor_mm is not None:
            pixel = stated.sensor_mm[0] / size[0], stated.sensor_mm[1] / size[1]
        known = dict(from_balanced(stated.balanced)) if stated.balanced else {}
        known |= {**dict(stated.fixed), **{name: value for name, (value, _) in stated.weighted}}
        known |= dict(stated.start) | approximate_values(stated, stated.name, given)
        if pixel is None:
            pixel = next((metadata[k].pixel_mm for k in photographs if metadata[k].pixel_mm), None)
        if focal is None:
            focal = known.get("c") or next(
                (metadata[k].focal_mm for k in photographs if metadata[k].focal_mm), None
            )
        if pixel is None:
            raise SurveyFileError(
                f"{where}: EXIF data of the photographs do not state the pixel size; "
                "needed pixel_mm or sensor_mm"
            )
        if max(pixel) > min(MAX_PIXEL_MM, MAX_PIXEL_RATIO * min(pixel)):
            raise SurveyFileError(
                f"{where}: a pixel of {pixel[0]:g} x {pixel[1]:g} mm, expected sides of at most "
                f"{MAX_PIXEL_MM:g} mm that differ by a factor of at most {MAX_PIXEL_RATIO:g}"
            )
        if focal is None:
            focal = next((known[name] * pixel[0] for name in ("fx", "f") if name in known), None)
        if focal is None:
            raise SurveyFileError(
                f"{where}: EXIF data of the photographs do not state the focal length; needed c_mm"
            )
        _refuse_implausible_view(where, size, pixel, focal)
        cameras.append(
            camera_from_values(
                stated.name,
                stated.model,
                size,
                pixel,
                c_mm=focal,
                free=stated.may_be_free,
                values=tuple(known.items()),
            )
        )
    return tuple(cameras)


def _refuse_implausible_view(
    where: str, size: tuple[int, int], pixel: tuple[float, float], focal: float
) -> None:
    """Raise SurveyFileError if no lens has such a field of view, since a length has a wrong unit."""
    diagonal = float(np.hypot(size[0] * pixel[0], size[1] * pixel[1]))

    def view_deg(pixel_factor: float, focal_factor: float) -> float:
        return float(np.degrees(2 * np.arctan(pixel_factor * diagonal / (2 * focal_factor * abs(focal)))))

    view = view_deg(1.0, 1.0)
    if MIN_VIEW_DEG <= view <= MAX_VIEW_DEG:
        return
    likely = [
        f"{name} in {unit}"
        for unit, factor in (("µm", 1e-3), ("m", 1e3), ("inch", 25.4))
        for name, factors in (("pixel_mm", (factor, 1.0)), ("c_mm", (1.0, factor)))
        if COMMON_VIEW_DEG[0] <= view_deg(*factors) <= COMMON_VIEW_DEG[1]
    ]
    raise SurveyFileError(
        f"{where}: pixels of {pixel[0]:g} x {pixel[1]:g} mm and c = {focal:g} mm make a field of view of "
        f"{view:.3g} degrees, expected {MIN_VIEW_DEG:g} to {MAX_VIEW_DEG:g}; "
        f"{' or '.join(likely) or 'a length in another unit than mm'}?"
    )


def approximate_values(settings: CameraSettings, name: str, given: StartCameras | None) -> dict[str, float]:
    """Return the values of [approximate] for a camera, by parameter.

    Free parameters start from them, and parameters that the survey file states nowhere are held at them.

    Args:
        settings: states the free parameters, and the values of others.
        name: name of the camera in the table, or of its photograph or group with separate values.
        given: the table, or None.
    """
    values = given.of(name) if given is not None else {}
    stated = {name for name, _ in (*settings.fixed, *settings.weighted)}
    if settings.balanced:
        stated |= {name for name, _ in from_balanced(settings.balanced)}
    if settings.c_mm is not None:
        stated |= {"c", "f"}
    return {
        parameter: value
        for parameter, value in values.items()
        if parameter in settings.may_be_free
        or (parameter in MODELS[settings.model].names and parameter not in stated)
    }


def refuse_unknown_cameras(settings: Sequence[CameraSettings], given: StartCameras | None) -> None:
    """Raise SurveyFileError if start values refer to a camera that is not in the survey.

    The names of photographs or groups begin with the name of their camera.

    Args:
        settings: cameras of the survey.
        given: start values of [approximate], or None.
    """
    for row, name in enumerate(given.camera if given is not None else ()):
        if given is not None and not base_name(name, (camera.name for camera in settings)):
            raise SurveyFileError(
                f"{given.table.place(row)}: camera '{name}' is not in the survey, expected one of "
                f"{', '.join(camera.name for camera in settings)}"
            )


def _common_size(
    settings: CameraSettings, sizes: list[tuple[str, tuple[int, int]]]
) -> tuple[int, int] | None:
    """Return the size of all photographs of one camera, px, None if nothing determines it."""
    size, source = settings.size_px, "size_px"
    for name, size_px in sizes:
        if size is None:
            size, source = size_px, f"'{name}'"
        elif size_px != size:
            raise PhotographError(
                f"camera {settings.name}: photograph '{name}' has {size_px[0]} x {size_px[1]} px, {source} "
                f"{size[0]} x {size[1]} px; photographs of one camera have one size"
            )
    return size


def split_cameras(
    cameras: Sequence[CameraSettings],
    network: Network,
    estimate: Estimate,
    given: StartCameras | None = None,
) -> tuple[Network, Estimate]:
    """Return the network and estimate with the interior orientations of the final adjustment.

    Args:
        cameras: cameras of the survey; they state which parameters are observed, and which are per photograph
            or per group.
        network: has one camera for each camera of the survey, in the same order.
        estimate: of this network.
        given: start values of single photographs or groups.

    Returns:
        Network and estimate with a camera for each photograph or group whose parameters vary; other
        parameters are shared. Observed parameters are free, and their values are among the observations.

    Raises:
        SurveyFileError: a photograph is in no group or in several, or the correlations belong to no
            covariance matrix.
    """
    if not any(camera.weighted or camera.per_photograph or camera.per_group for camera in cameras):
        return network, estimate
    variants: list[Camera] = []
    owner = np.empty(len(network.images), dtype=np.int64)
    observed: list[tuple[int, int, float, float]] = []
    rho: dict[tuple[int, int, int], float] = {}
    for a, settings in enumerate(cameras):
        images = np.flatnonzero(network.camera == a)
        first = len(variants)
        made, member = _photograph_cameras(settings, estimate.cameras[a], [network.images[i] for i in images])
        for camera in made:  # a parameter that several cameras share starts from the survey file's camera
            p = camera.parameters.copy()
            for name, value in approximate_values(settings, camera.name, given).items():
                s = camera.names.index(name)
                p[s] = p[s] if camera.group_of(s) else value
            variants.append(camera.with_parameters(p))
        owner[images] = first + member
        for name, (value, sigma) in settings.weighted:
            s = made[0].names.index(name)
            groups = [camera.owner_of(s) for camera in made]
            first_of = {group: k for k, group in reversed(list(enumerate(groups)))}
            observed += [(first + first_of[group], s, value, sigma) for group in dict.fromkeys(groups)]
        place = made[0].names.index
        rho |= {(first, place(p), place(q)): value for p, q, value in settings.correlations}
    columns = list(zip(*observed, strict=True)) or [(), (), (), ()]
    interior = InteriorObservations(
        np.array(columns[0], dtype=np.int64),
        np.array(columns[1], dtype=np.int64),
        np.array(columns[2], dtype=float),
        np.array(columns[3], dtype=float),
        np.array(_correlation(observed, rho)) if rho else None,
    )
    return (
        replace(network, camera=owner).with_given(interior),
        replace(estimate, cameras=tuple(variants)),
    )


def _correlation(
    observed: list[tuple[int, int, float, float]], rho: dict[tuple[int, int, int], float]
) -> FloatArray:
    """Return the correlation matrix of the observed parameters, (p, p).

    Args:
        observed: (camera, parameter, value, sigma) of p parameters.
        rho: correlations by camera and both parameters.

    Raises:
        SurveyFileError: they belong to no covariance matrix.
    """
    R = np.eye(len(observed))
    place = {(camera, parameter): k for k, (camera, parameter, _, _) in enumerate(observed)}
    for (camera, p, q), value in rho.items():
        j, k = place[camera, p], place[camera, q]
        R[j, k] = R[k, j] = value
    if np.linalg.eigvalsh(R).min() <= MIN_EIGENVALUE:
        raise SurveyFileError(
            "correlations of the weighted interior orientation: no such covariance matrix exists"
        )
    return R


def without_idle_cameras(network: Network, estimate: Estimate, *, count: int) -> tuple[Network, Estimate]:
    """Return the network and estimate without the cameras of single photographs that were removed.

    Args:
        network: result of `split_cameras`, or a part of it.
        estimate: of this network.
        count: number of cameras of the survey; with only so many cameras nothing is removed.
    """
    if len(estimate.cameras) == count:
        return network, estimate
    used = np.zeros(len(estimate.cameras), dtype=bool)
    used[network.camera] = True
    number = np.cumsum(used) - 1
    seen = network.interior
    keep = used[seen.camera]
    interior = InteriorObservations(
        number[seen.camera[keep]],
        seen.parameter[keep],
        seen.value[keep],
        seen.sigma[keep],
        None if seen.correlation is None else seen.correlation[np.ix_(keep, keep)],
    )
    observations = tuple(
        kind.of_cameras(used) if isinstance(kind, MountObservations) else kind for kind in network.further
    )
    mounts = None if estimate.mounts is None else estimate.mounts.select(used)
    cameras = tuple(c for c, on in zip(estimate.cameras, used, strict=True) if on)
    return (
        replace(network, camera=number[network.camera]).with_given(interior, further=observations),
        replace(estimate, cameras=cameras, mounts=mounts),
    )


def refuse_ungrouped(
    cameras: Sequence[CameraSettings], images: Iterable[str], camera: Iterable[int], source: str
) -> None:
    """Raise SurveyFileError if a photograph is in no group of its camera, or in several.

    Args:
        cameras: cameras of the survey.
        images: names of the photographs.
        camera: camera index of each photograph.
        source: name of the survey in error messages.
    """
    for image, a in zip(images, camera, strict=True):
        if cameras[a].groups:
            group_of_image(cameras[a], image, source)


def group_of_image(settings: CameraSettings, image: str, source: str = "survey") -> int:
    """Return the index of the group that a photograph of a camera belongs to.

    Args:
        settings: states the groups.
        image: name of the photograph.
        source: name of the survey in error messages.

    Raises:
        SurveyFileError: the photograph is in no group or in several.
    """
    matches = [g for g, glob in enumerate(settings.groups) if fnmatch.fnmatchcase(image, glob)]
    if len(matches) != 1:
        many = "no group" if not matches else f"{counted(len(matches), 'group')}"
        raise SurveyFileError(
            f"{source}: camera {settings.name}: photograph '{image}' is in {many} of groups "
            f"{', '.join(settings.groups)}; one is needed"
        )
    return matches[0]


def _photograph_cameras(
    settings: CameraSettings, camera: Camera, images: list[str]
) -> tuple[list[Camera], IntArray]:
    """Return a camera for each photograph or group with varying parameters, and each photograph's camera."""
    observed = [name for name, _ in settings.weighted]
    camera = replace(camera, free=camera.free | np.array([name in observed for name in camera.names]))
    grouped = [group_of_image(settings, image) if settings.groups else 0 for image in images]
    if not images or not (settings.per_photograph or settings.per_group):
        return [camera], np.zeros(len(images), dtype=np.int64)
    labels = [f"{camera.name} {settings.groups[g]}" if settings.groups else camera.name for g in grouped]
    names = [f"{camera.name} {image}" for image in images] if settings.per_photograph else labels

    def shared(parameter: str, label: str) -> str:
        if parameter in settings.per_photograph:
            return ""
        return label if parameter in settings.per_group else camera.name

    made = {
        name: replace(camera, name=name, shared=tuple(shared(p, label) for p in camera.names))
        for name, label in zip(names, labels, strict=True)
    }
    number = {name: k for k, name in enumerate(made)}
    return list(made.values()), np.array([number[name] for name in names], dtype=np.int64)
