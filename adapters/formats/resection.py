"""The pose of one photograph by space resection: what `kolinear resect --json` prints.

    photograph              its name
    solutions               best first: X0, Y0, Z0, M (3 x 3, object axes to image axes), rms_mm
    dispersion              (may be missing) covariance of X0, Y0, Z0, omega, phi, kappa, object unit and deg

The first solution is the pose. Its covariance makes it an observed pose. The coordinates are those of the
points that it rests on, which are not in the file.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from adapters.formats.cameras.lens_terms import is_rotation
from adapters.formats.content import Content
from adapters.formats.stated_model import StatedModel, content_of, unstated_camera
from adapters.reading.trees import read_tree
from sfm.model.conventions import angles_from_rotation

WHAT = "resection"
ROUNDING = 1e-9  # of the eigenvalues of correlations


def read_resection(path: Path) -> Content:
    """Read the pose of the photograph.

    Raises:
        SurveyFileError: with the file and its key.
    """
    tree, stated = read_tree(path, WHAT), StatedModel(path)
    stated.cameras.append(unstated_camera(stated))
    solutions = tree.items("solutions")
    if not solutions:
        raise tree.error("solutions is empty: the resection found no pose")
    if len(solutions) > 1:
        stated.notes.append(f"{len(solutions)} solutions fit as well; the first is read")
    best = solutions[0]
    position = np.array([best.number(name) for name in ("X0", "Y0", "Z0")])
    rotation = best.numbers(("M",), 9).reshape(3, 3).T
    if not is_rotation(rotation):
        raise best.error("M is no rotation")
    stated.add_image(tree.text("photograph"), 0, position, rotation)
    if tree.key("dispersion"):
        unit = np.array([1, 1, 1, *[np.radians(1.0)] * 3])
        C = tree.numbers(("dispersion",), 36).reshape(6, 6) * np.outer(unit, unit)
        sigma = np.sqrt(np.maximum(np.diag(C), 0.0))
        if not (sigma > 0).all():
            raise tree.error("dispersion is no covariance: the variances must be positive")
        correlation = C / np.outer(sigma, sigma)
        if not np.allclose(correlation, correlation.T) or np.linalg.eigvalsh(correlation)[0] < -ROUNDING:
            raise tree.error("dispersion is no covariance, which is symmetric and not negative")
        stated.exterior[0] = position, angles_from_rotation(rotation), C
    return content_of(stated)
