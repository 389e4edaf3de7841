"""The pose of one photograph by space resection: what `kolinear resect --json` prints.

    photograph              its name
    solutions               best first: X0, Y0, Z0, M (3 x 3, object axes to image axes), rms_mm
    dispersion              (may be missing) covariance of X0, Y0, Z0, omega, phi, kappa, object unit and deg
    redundancy              (may be missing) of the resection, from whose residuals the covariance is

The first solution is the pose, in the coordinates of the known points. Its covariance makes it an observed
pose too. The coordinates are those of the
points that it rests on, which are not in the file.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from adapters.formats.cameras.lens_terms import is_rotation
from adapters.formats.content import Content
from adapters.formats.stated_model import StatedModel, content_of, unstated_camera
from adapters.reading.trees import head_of, read_tree
from sfm.model.conventions import angles_from_rotation
from sfm.model.errors import SurveyFileError

WHAT = "resection"
ROUNDING = 1e-9  # of the eigenvalues of correlations


def read_resection(path: Path) -> Content:
    """Read the pose of the photograph.

    Raises:
        SurveyFileError: with the file and its key; it has the results of all methods.
    """
    if head_of(path).lstrip().startswith("["):
        raise SurveyFileError(
            f"{path}: has the results of all methods; expected those of one, such as resect --method robust"
        )
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
    content = content_of(stated)
    covariance = stated.exterior[0][2][None] if stated.exterior else None
    redundancy = tree.number("redundancy") if tree.key("redundancy") else None
    if redundancy is not None and not (redundancy >= 1 and redundancy == int(redundancy)):
        raise tree.error(f"redundancy is {redundancy:g}, expected a whole number from 1")
    return replace(
        content,
        result=replace(
            content.result,
            datum="control",
            exterior_covariance=covariance,
            redundancy=None if redundancy is None else int(redundancy),
        ),
    )
