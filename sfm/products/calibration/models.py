"""Which parameters of its camera model a set of photographs bears: leaner and wider models compared.

Each alternative leaves out a group of adjusted parameters, or adds one that was held: the last radial term,
decentring, affinity, shear. It is adjusted with all unknowns, and decided by the likelihood that decides all
choices of a survey: the gain of ln likelihood, minus the price of the parameters.

Source: `sfm.judgement.model_choice`; Kass and Raftery (1995), J. Am. Stat. Assoc. 90.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from sfm.adjustment.datum import Datum
from sfm.adjustment.result import Adjustment
from sfm.adjustment.solve import AdjustmentOptions, adjust
from sfm.model.arguments import checked_arguments
from sfm.model.camera import Camera
from sfm.model.conventions import BoolArray
from sfm.model.distortion.models import Role
from sfm.model.errors import GeometryError
from sfm.model.likelihood import price_of

GROUPS = {  # roles that are added or left out together
    "radial": (Role.RADIAL, Role.DENOMINATOR),
    "decentring": (Role.DECENTRING,),
    "affinity": (Role.AFFINITY,),
    "shear": (Role.SHEAR,),
}


@dataclass(frozen=True)
class Alternative:
    """A camera model with parameters added to the adjusted one, or left out of it."""

    camera: str
    added: bool  # whether parameters were added; otherwise they were left out
    parameters: tuple[str, ...]  # that were added or left out
    gain: float  # of ln likelihood by the wider of the two models; NaN without a solution
    price: float  # of its further parameters

    @property
    def borne(self) -> bool:
        """Whether the photographs bear the wider of the two models."""
        return self.gain > self.price

    @property
    def contradicts(self) -> bool:
        """Whether the photographs bear another model than the adjusted one."""
        return bool(np.isfinite(self.gain)) and self.borne == self.added


@checked_arguments()
def compare_models(adjustment: Adjustment, camera: int = 0) -> tuple[Alternative, ...]:
    """Return the alternatives to the free parameters of a camera.

    Args:
        adjustment: finished.
        camera: index of the camera.

    Example:
        >>> from sfm.products.calibration import compare_models
        >>> all(alternative.price > 0 for alternative in compare_models(result.adjustment))
        True
    """
    present = adjustment.estimate.cameras[camera]
    if not present.free.any():
        return ()
    network = adjustment.network
    owner = network.camera[network.image_points.image[~adjustment.rejected]]
    others: list[tuple[bool, BoolArray]] = []  # whether parameters are added, and which are added or left out
    for group, roles in GROUPS.items():
        mine = np.flatnonzero(present.plays(*roles))
        free, held = mine[present.free[mine]], mine[~present.free[mine]]
        last = slice(-1, None) if group == "radial" else slice(None)
        for added, chosen in ((False, free[last]), (True, held[:1] if group == "radial" else held)):
            if len(chosen):
                others.append((added, np.isin(np.arange(len(present.names)), chosen)))
    search = float(np.log(max(len(others), 1) / adjustment.levels.family))
    none = np.zeros_like(present.free)
    own = _squares(adjustment, camera, none)
    compared = []
    for added, changed in others:
        lean, wide = own, _squares(adjustment, camera, changed)
        if not added:
            lean, wide = wide, own
        gain = float("nan")
        if lean is not None and wide is not None and wide[0] > 0:
            gain = wide[1] / 2 * float(np.log(lean[0] / wide[0]))
        names = tuple(name for name, new in zip(present.names, changed, strict=True) if new)
        seen = int(np.isin(owner, _sharing(adjustment.estimate.cameras, camera, changed)).sum())
        price = price_of(len(names), seen, search if added else 0.0)
        compared.append(Alternative(present.name, added, names, gain, price))
    return tuple(compared)


def _squares(adjustment: Adjustment, camera: int, changed: BoolArray) -> tuple[float, int] | None:
    """Return v'Pv and redundancy with some parameters free in place of held, or held at 0; None if it fails.

    They change for all cameras that share them with the camera.
    """
    network, estimate, kept = adjustment.network, adjustment.estimate, ~adjustment.rejected
    cameras = list(estimate.cameras)
    for k in _sharing(estimate.cameras, camera, changed):
        other = cameras[k]
        values = np.where(changed & other.free, 0.0, other.parameters)
        cameras[k] = replace(other, free=other.free ^ changed, parameters=values)
    try:
        adjusted = adjust(
            replace(network, image_points=network.image_points.select(kept)),
            replace(estimate, cameras=tuple(cameras)),
            datum=Datum("control" if adjustment.datum == "control" else "free"),
            reject="none",
            covariance=False,
            options=AdjustmentOptions(image_sigma_factor=adjustment.image_sigma_factor[kept]),
        )
    except (GeometryError, np.linalg.LinAlgError):
        return None
    return (adjusted.vPv, adjusted.redundancy) if adjusted.converged else None


def _sharing(cameras: Sequence[Camera], camera: int, changed: BoolArray) -> list[int]:
    """Return the indices of a camera and of those that share the changed parameters with it."""
    present, parameters = cameras[camera], np.flatnonzero(changed).tolist()
    groups = [present.group_of(s) for s in parameters]

    def shares(other: Camera) -> bool:
        return other.model == present.model and [other.group_of(s) for s in parameters] == groups

    return [k for k, other in enumerate(cameras) if k == camera or (all(groups) and shares(other))]
