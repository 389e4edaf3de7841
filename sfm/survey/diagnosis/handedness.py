"""Whether anything shows that image points are mirrored: the image points themselves fit as well turned over.

The mirror image of an object, seen in mirrored photographs, has the residuals of the object. Only given
points that do not lie in a plane, which a mirror leaves as it is, tell the two apart.
"""

from __future__ import annotations

import numpy as np

from sfm.comparison.congruency import extended_axes
from sfm.network import Network
from sfm.remarks.remark import Remark, remark
from sfm.survey.inputs.survey import Survey


def handedness_remarks(survey: Survey, network: Network) -> tuple[Remark, ...]:
    """Return the note on image points of a file whose handedness nothing that was given checks.

    Args:
        survey: gives points and photographs.
        network: adjusted; given places that it does not contain check nothing.
    """
    if survey.observations is None:
        return ()
    points = [(one.names, one.xyz) for one in (survey.control, survey.start_points) if one is not None]
    photographs = []
    if survey.exterior is not None:
        photographs.append((survey.exterior.names, survey.exterior.value[:, :3]))
    if survey.start_orientations is not None:
        photographs.append((survey.start_orientations.names, survey.start_orientations.position))
    places = [
        xyz[k]
        for given, known in ((points, set(network.points)), (photographs, set(network.images)))
        for names, xyz in given
        for k, name in enumerate(names)
        if name in known and np.isfinite(xyz[k]).all()
    ]
    if len(places) > 3 and len(extended_axes(np.array(places))[0]) == 3:
        return ()
    return (remark("handedness_unchecked"),)
