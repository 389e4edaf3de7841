"""Measurements of the photographs of a survey: targets, natural texture, or given image points."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from sfm.camera import Camera
from sfm.conventions import IntArray
from sfm.network import Network
from sfm.remarks.remark import Remark
from sfm.result import FailedImage, LeftOutPoint, PhotographTargets
from sfm.survey.inputs.photograph_list import PhotographList
from sfm.targets.codes.tags import CORNERS
from sfm.targets.detect import Targets


@dataclass(frozen=True)
class MeasuredPhotographs:
    """The readable photographs of a survey with their targets, and those that could not be read."""

    names: tuple[str, ...]  # (m,)
    paths: tuple[Path, ...]  # (m,)
    camera: IntArray  # index into cameras, (m,)
    cameras: tuple[Camera, ...]  # with start values of the interior orientation
    targets: tuple[Targets, ...]  # (m,)
    failed: tuple[FailedImage, ...]  # photographs that could not be read
    stored: tuple[bool, ...] = ()  # whether the targets were measured in an earlier run, (m,) or none

    def overlays(self) -> tuple[PhotographTargets, ...]:
        """Return what the report draws into each photograph."""
        return tuple(
            PhotographTargets(
                name,
                path,
                found.xy,
                found.semi_axes,
                found.angle,
                found.rejected_xy,
                found.rejected_flag,
                found.flag,
                stored,
                found.blur,
                self.cameras[camera].name,
            )
            for name, path, found, stored, camera in zip(
                self.names,
                self.paths,
                self.targets,
                self.stored or (False,) * len(self.names),
                self.camera,
                strict=True,
            )
        )


@dataclass(frozen=True)
class Naming:
    """Which object point every measured target is."""

    names: tuple[str, ...]  # of the object points: code number, tag and corner, or u and a number, (n,)
    code: IntArray  # code number of each point, of a corner as in TagCorners, -1 = uncoded, (n,)
    point: tuple[IntArray, ...]  # of each photograph, the point of each target or UNNAMED, (k_i,)
    corners: bool = False  # whether the coded points are corners of tags

    def codes(self, network: Network) -> IntArray:
        """Return the code number or the tag of each point of a network, -1 where uncoded, (n,)."""
        per_code = len(CORNERS) if self.corners else 1
        code = dict(zip(self.names, self.code // per_code, strict=True))
        return np.array([code[name] for name in network.points], dtype=np.int64)


@dataclass(frozen=True)
class Measurements:
    """The image points of a survey that have a name, and what they come from."""

    network: Network  # image points with their covariance; control and scale bars among the points
    cameras: tuple[Camera, ...]  # with start values of the interior orientation
    images: tuple[str, ...]  # all photographs of the survey, also those that could not be read
    min_rays: IntArray  # photographs that each point needs, (n,)
    failed: tuple[FailedImage, ...] = ()  # photographs that could not be read
    overlays: tuple[PhotographTargets, ...] = ()  # what the report draws into each photograph
    files: PhotographList | None = None  # None with observations
    photographs: MeasuredPhotographs | None = None  # with all targets, uncoded ones too; None without targets
    naming: Naming | None = None  # of these targets
    remarks: tuple[Remark, ...] = ()  # on what was given and measured
    left_out: tuple[LeftOutPoint, ...] = ()  # image points that contradict one another
