"""Natural points of one photograph, found before any other photograph is read."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sfm.arguments import checked_arguments
from sfm.conventions import AnyArray, FloatArray
from sfm.errors import GeometryError
from sfm.matching.tracks.features import Features, sift_features
from sfm.matching.tracks.interest import foerstner_points

DETECTORS = ("foerstner", "sift")


@dataclass(frozen=True)
class NaturalPoints(Features):
    """SIFT features of a photograph, and the places in it at which matching is the most precise."""

    corners: FloatArray  # px, the strongest first, (c, 2); none where features stay where they are


@checked_arguments()
def natural_points(
    photograph: AnyArray, *, detector: str = "foerstner", max_features: int = 2000
) -> NaturalPoints:
    """Find what photographs of natural texture are linked and measured by, in one of them.

    Args:
        photograph: (H, W), 8 or 16 bit, grey or colour.
        detector: foerstner finds places for the points, sift leaves them on their features.
        max_features: the strongest ones of all parts of the photograph.

    Raises:
        GeometryError: an unknown detector.

    Source: Lowe (2004), IJCV 60(2), for the features; Foerstner and Guelch (1987) for the places.
    """
    if detector not in DETECTORS:
        raise GeometryError(f"tie points: detector '{detector}', expected one of {', '.join(DETECTORS)}")
    found = sift_features(photograph, max_features=max_features)
    corners = foerstner_points(photograph).xy if detector == "foerstner" else np.zeros((0, 2))
    return NaturalPoints(found.xy, found.scale, found.angle, found.descriptor, corners)
