"""Interior orientation as the survey asks for it: of all photographs, of groups, or of each; observed or not.

Approximate values are found with one interior orientation for each camera of the survey file, in which
observed parameters keep their observed values. Only the final adjustment has the image-variant one.

Source: Luhmann et al., Close-Range Photogrammetry and 3D Imaging (2020), sec. 4.4.2 (image-variant
interior orientation).
"""

from __future__ import annotations

import fnmatch
from collections.abc import Iterable, Sequence
from dataclasses import replace

import numpy as np

from sfm.camera import Camera
from sfm.conventions import FloatArray, IntArray
from sfm.display import counted
from sfm.errors import SurveyFileError
from sfm.network import Estimate, InteriorObservations, Network
from sfm.observations.mounts import MountObservations
from sfm.survey.inputs.cameras import free_start_values
from sfm.survey.inputs.given import StartCameras
from sfm.survey.inputs.settings import CameraSettings

MIN_EIGENVALUE = 1e-12  # smallest eigenvalue of a matrix of correlations below which it is none


def split_cameras(
    cameras: Sequence[CameraSettings],
    network: Network,
    estimate: Estimate,
    given: StartCameras | None = None,
) -> tuple[Network, Estimate]:
    """Return the network and estimate with the interior orientations that the final adjustment has.

    Args:
        cameras: of the survey; they state which parameters are observed, of each photograph, or of each
            group.
        network: with one camera for each of the survey's, in their order.
        estimate: of the same.
        given: start values of single photographs or groups.

    Returns:
        The same with a camera for each photograph or group where parameters vary between these; the others
        it shares. Observed parameters are free, and their values are among the observations.

    Raises:
        SurveyFileError: a photograph is in no group, or in more than one.
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
        made, member = _variants(settings, estimate.cameras[a], [network.images[i] for i in images])
        variants += [_started(camera, settings, given) for camera in made]
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
        replace(network, camera=owner, interior=interior),
        replace(estimate, cameras=tuple(variants)),
    )


def _correlation(
    observed: list[tuple[int, int, float, float]], rho: dict[tuple[int, int, int], float]
) -> FloatArray:
    """Return the correlations of the observed parameters, by camera and index of both, (p, p).

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


def _started(camera: Camera, settings: CameraSettings, given: StartCameras | None) -> Camera:
    """Return the camera of a photograph or group with the start values given for it.

    A parameter that several cameras share starts from one value, that of the camera of the survey file.
    """
    p = camera.parameters.copy()
    for name, value in free_start_values(settings, camera.name, given).items():
        s = camera.names.index(name)
        if not camera.group_of(s):
            p[s] = value
    return camera.with_parameters(p)


def without_idle_cameras(network: Network, estimate: Estimate, *, count: int) -> tuple[Network, Estimate]:
    """Return the network and estimate without the cameras of single photographs that have left it.

    Args:
        network: as `split_cameras` returns it, or a part.
        estimate: of the same.
        count: of cameras of the survey; as many stay as they are.
    """
    if len(estimate.cameras) == count:
        return network, estimate
    used = np.zeros(len(estimate.cameras), dtype=bool)
    used[network.camera] = True
    number = np.cumsum(used) - 1
    seen = network.interior
    keep = used[seen.camera]
    interior = InteriorObservations(
        *(number[seen.camera[keep]], seen.parameter[keep], seen.value[keep], seen.sigma[keep]),
        None if seen.correlation is None else seen.correlation[np.ix_(keep, keep)],
    )
    observations = tuple(
        one.of_cameras(used) if isinstance(one, MountObservations) else one for one in network.observations
    )
    mounts = None if estimate.mounts is None else estimate.mounts.select(used)
    cameras = tuple(c for c, on in zip(estimate.cameras, used, strict=True) if on)
    return (
        replace(network, camera=number[network.camera], interior=interior, observations=observations),
        replace(estimate, cameras=cameras, mounts=mounts),
    )


def refuse_ungrouped(
    cameras: Sequence[CameraSettings], images: Iterable[str], camera: Iterable[int], source: str
) -> None:
    """Raise SurveyFileError if a photograph is in no group of its camera, or in more than one.

    Args:
        cameras: of the survey.
        images: names of the photographs.
        camera: index of the camera of each of them.
        source: what messages call the survey.
    """
    for image, a in zip(images, camera, strict=True):
        if cameras[a].groups:
            group_of_image(cameras[a], image, source)


def group_of_image(settings: CameraSettings, image: str, source: str = "survey") -> int:
    """Return the index of the group that a photograph of a camera belongs to.

    Raises:
        SurveyFileError: no group, or more than one.
    """
    matches = [g for g, glob in enumerate(settings.groups) if fnmatch.fnmatchcase(image, glob)]
    if len(matches) != 1:
        many = "no group" if not matches else f"{counted(len(matches), 'group')}"
        raise SurveyFileError(
            f"{source}: camera {settings.name}: photograph '{image}' is in {many} of groups "
            f"{', '.join(settings.groups)}; one is needed"
        )
    return matches[0]


def _variants(settings: CameraSettings, camera: Camera, images: list[str]) -> tuple[list[Camera], IntArray]:
    """Return a camera for each photograph or group whose parameters vary, and whose is whose."""
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
