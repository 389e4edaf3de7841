"""Cameras as a file has them: by name, with what the file or result says of their precision and mounts."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from sfm.model.camera import Camera
from sfm.model.conventions import FloatArray
from sfm.model.display import counted, listed
from sfm.model.errors import SurveyFileError, UnknownNameError
from sfm.model.estimate import Mounts
from sfm.model.solution import Solution

SHOWN = 8  # names that an error message lists


@dataclass(frozen=True)
class CameraFile:
    """Calibrated cameras, read from a file or taken from a result.

    Example:
        >>> import sfm
        >>> camera = sfm.camera_from_values("left", "opencv", (640, 480), (0.01, 0.01), c_mm=5.0)
        >>> CameraFile("pair", (camera,), (None,)).only("left").cameras[0].value("fx")
        500.0
    """

    name: str
    """name of the file or result"""
    cameras: tuple[Camera, ...]
    """the a cameras, each with a name of its own"""
    covariance: tuple[FloatArray | None, ...]
    """of all parameters of each camera, in their units, 0 for those held fixed, (p, p); None if unknown"""
    mounts: Mounts | None = None
    """mounts of the cameras in one rig; None if unknown"""
    unit: str = ""
    """unit of the mounts; empty if unknown"""
    rms_px: tuple[float, ...] = ()
    """root mean square residual of an image coordinate of each camera, px; empty if unknown"""
    solution: Solution | None = None
    """the result that calibrated the cameras, with its image points; None if only the cameras are known"""

    def __post_init__(self) -> None:
        if len(self.covariance) != len(self.cameras) or len(self.rms_px) not in (0, len(self.cameras)):
            raise SurveyFileError(
                f"{self.name}: {counted(len(self.covariance), 'covariance')} of "
                f"{counted(len(self.cameras), 'camera')}, needed one of each, None if unknown"
            )

    def index(self, name: str) -> int:
        """Return the index of a camera.

        Raises:
            UnknownNameError: no camera has that name.
        """
        names = [camera.name for camera in self.cameras]
        if name not in names:
            raise UnknownNameError(f"{self.name}: no camera '{name}', it has {listed(names, most=SHOWN)}")
        return names.index(name)

    def only(self, name: str | None) -> CameraFile:
        """Return the file with one camera only.

        Args:
            name: name of the camera; None if there is only one.

        Raises:
            UnknownNameError: no camera has that name.
            SurveyFileError: there are several cameras, and no name is given.
        """
        if name is None and len(self.cameras) > 1:
            names = [camera.name for camera in self.cameras]
            raise SurveyFileError(
                f"{self.name}: {counted(len(names), 'camera')}, one is needed; name it with --camera: "
                f"{listed(names, most=SHOWN)}"
            )
        k = 0 if name is None else self.index(name)
        return replace(
            self,
            cameras=(self.cameras[k],),
            covariance=(self.covariance[k],),
            mounts=None,
            rms_px=self.rms_px[k : k + 1],
        )

    def image_points(self, name: str) -> FloatArray | None:
        """Return the image points that calibrated a camera, px, (k, 2); None if unknown."""
        if self.solution is None:
            return None
        names = [camera.name for camera in self.solution.estimate.cameras]
        seen = self.solution.network.image_points
        return np.asarray(seen.xy[self.solution.network.camera[seen.image] == names.index(name)])


def cameras_of(solution: Solution, rms_px: tuple[float, ...] = ()) -> CameraFile:
    """Return the cameras of a result with the covariance of their interior orientation.

    Args:
        solution: the result.
        rms_px: root mean square residual of an image coordinate of each camera, px, where known.
    """
    cameras = solution.estimate.cameras
    covariance: list[FloatArray | None] = []
    for k, camera in enumerate(cameras):
        known = solution.interior_covariance[k] if k < len(solution.interior_covariance) else np.zeros((0, 0))
        free = np.flatnonzero(camera.free)
        if not len(known) or len(known) != len(free) or not np.isfinite(known).all():
            covariance.append(None)
            continue
        full = np.zeros((len(camera.parameters), len(camera.parameters)))
        full[np.ix_(free, free)] = known
        covariance.append(full)
    return CameraFile(
        solution.name,
        cameras,
        tuple(covariance),
        solution.estimate.mounts,
        solution.unit,
        rms_px,
        solution,
    )
