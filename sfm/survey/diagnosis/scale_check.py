"""Scale bars whose lengths differ grossly from one another, found before anything is adjusted on them.

The shape of a network comes from its photographs alone; each bar, and the control as a whole, says how large
it is. A length that is wrong by a factor would bend the network beyond all tests. More than half of what
tells the scale must agree to say which of them is wrong; else none of the bars is believed.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from sfm.conventions import BoolArray, FloatArray
from sfm.network import Estimate, Network, ScaleBars
from sfm.remarks.remark import Remark, remark
from sfm.result import TakenOut

SAME_SCALE = 0.05  # relative difference that start values may have; what is smaller is left to the tests
MIN_CONTROL = 3  # points that tell a scale which they check themselves


@dataclass(frozen=True)
class ScaleCheck:
    """A network without the bars that were taken out."""

    network: Network
    taken_out: tuple[TakenOut, ...] = ()
    remarks: tuple[Remark, ...] = ()


def check_scales(network: Network, estimate: Estimate, *, held: bool) -> ScaleCheck:
    """Take out scale bars that contradict the others, or all of them where none can be believed.

    Args:
        network: all image points, with control and bars.
        estimate: start values in any scale.
        held: whether the control takes part in the adjustment.
    """
    bars = network.scale_bars
    found = np.linalg.norm(estimate.points[bars.end] - estimate.points[bars.start], axis=1)
    known = np.isfinite(found) & (found > 0)
    scale = np.where(known, bars.length / np.where(known, found, 1.0), np.nan)
    by_control, votes = _scale_of_control(network, estimate) if held else (np.nan, 0)
    voters = np.concatenate([scale[known], np.full(votes, by_control)])
    if len(voters) < 2 or _agree(voters, float(np.median(voters))).all():
        return ScaleCheck(network)
    counts = [int(_agree(voters, one).sum()) for one in voters]
    best = int(np.argmax(counts))
    told = 2 * counts[best] > len(voters)
    wrong = known & ~_agree(scale, voters[best]) if told else known
    if not wrong.any():
        return ScaleCheck(network)
    right = float(np.median(voters[_agree(voters, voters[best])])) if told else np.nan
    out, lines = [], []
    for b in np.flatnonzero(wrong):
        name = f"scale bar {network.points[bars.start[b]]} - {network.points[bars.end[b]]}"
        off = float(scale[b] / right - 1) if told else float(scale[known].max() / scale[known].min() - 1)
        out.append(TakenOut(name, abs(off), resolved=told))
        if told:
            lines.append(
                f"{name} does not fit: its length is {1 + off:.4g} times what the others give; it was taken "
                "out"
            )
    if not told:
        names = ", ".join(one.what for one in out)
        against = "one another and the control" if votes else "one another"
        lines = [
            f"{names} contradict {against} by a factor of {1 + out[0].relative:.4g}, and which one is wrong "
            "cannot be told; none of them was used"
        ]
    keep = ~wrong
    left = ScaleBars(bars.start[keep], bars.end[keep], bars.length[keep], bars.sigma[keep])
    return ScaleCheck(
        replace(network, scale_bars=left),
        tuple(out),
        tuple(remark("given_remarkable", line=one) for one in lines),
    )


def _agree(scale: FloatArray, one: float) -> BoolArray:
    """Return which scales are the same as one within what start values may be off, False where NaN."""
    with np.errstate(invalid="ignore"):
        return np.asarray(np.abs(np.log(scale / one)) <= np.log1p(SAME_SCALE))


def _scale_of_control(network: Network, estimate: Estimate) -> tuple[float, int]:
    """Return the scale by the distances between control points, and by how many bars it counts."""
    control = network.control.complete
    known = np.flatnonzero(estimate.determined[control.point])
    if len(known) < MIN_CONTROL:
        return float("nan"), 0
    given, point = control.xyz[known], control.point[known]
    length = np.linalg.norm(np.diff(given, axis=0), axis=1)
    found = np.linalg.norm(np.diff(estimate.points[point], axis=0), axis=1)
    usable = (length > 0) & (found > 0)
    return (float(np.median(length[usable] / found[usable])), len(known) - 2) if usable.any() else (np.nan, 0)
