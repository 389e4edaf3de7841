"""Quality flags of targets and of rejected candidates: the one list of reasons.

A measured target may carry several remarks (`SATURATED`, `CODE_UNREADABLE`, ...); a candidate that is not
measured carries the first reason that excluded it.
"""

from __future__ import annotations

from enum import IntFlag

from sfm.conventions import IntArray


class Flag(IntFlag):
    """Remarks on a target (kept) and reasons for a rejection, one bit each."""

    NONE = 0
    # remarks: the target is measured and kept
    SATURATED = 1 << 0  # pixels at the end of the scale were censored
    CODE_UNREADABLE = 1 << 1  # something like a code surrounds the dot, but no valid code was read
    SHADED = 1 << 2  # the gain changes by more than 3 sigma of it across the target
    CLOSE_NEIGHBOUR = 1 << 3  # part of the background was left out because something else is there
    CORNER = 1 << 4  # the corner of a square tag, no circle
    HALO = 1 << 5  # the background falls off from the edge: light scattered about a retro-reflective target
    FLARE = 1 << 6  # the background is saturated or changes strongly across the target: glare on its surface
    CROSSING = 1 << 7  # a crossing of a checkerboard, no circle
    # reasons for a rejection
    CUT_BY_BORDER = 1 << 8  # the border of the photograph cuts the target or its background
    TOO_SMALL = 1 << 9  # below min_diameter_px
    TOO_LARGE = 1 << 10  # above max_diameter_px
    TOO_OBLIQUE = 1 << 11  # axis ratio below that of a circle seen at 75 degrees
    NOT_ELLIPTIC = 1 << 12  # the outline is not an ellipse
    LOW_CONTRAST = 1 << 13  # the step of intensity is too small for the noise
    UNEVEN_EDGE = 1 << 14  # the edge is missing or different on part of the circumference
    POOR_FIT = 1 << 15  # the intensities differ from the model of a blurred ellipse
    BLURRED = 1 << 16  # the edge is too soft for the size
    NO_CONVERGENCE = 1 << 17  # the least squares fit did not converge on this outline
    DUPLICATE = 1 << 18  # the same target was found twice
    PART_OF_CODE = 1 << 19  # inside the code ring of another target
    LOBED = 1 << 20  # the outline deviates from the ellipse as bars and squares do
    THIN_BACKGROUND = 1 << 21  # the background is only a thin stroke, as in a letter "o"
    NOT_ON_PLATE = 1 << 22  # no dot of the calibration plate
    # other remarks
    DAMAGED = 1 << 23  # a nick, a scratch or a mark in the target was left out of the fit
    CONCENTRIC = 1 << 24  # the image of the common centre of rings, not eccentric


# Reasons for a rejection, those first of which a candidate is most like a target: it has passed the tests of
# those below, which `candidates` asks first. The last two are no targets lost.
LIKEST_FIRST = (
    *(Flag.NOT_ON_PLATE, Flag.POOR_FIT, Flag.THIN_BACKGROUND, Flag.LOBED, Flag.UNEVEN_EDGE, Flag.BLURRED),
    *(Flag.LOW_CONTRAST, Flag.TOO_OBLIQUE, Flag.TOO_LARGE, Flag.NO_CONVERGENCE, Flag.CUT_BY_BORDER),
    *(Flag.NOT_ELLIPTIC, Flag.TOO_SMALL, Flag.PART_OF_CODE, Flag.DUPLICATE),
)


def count_flags(flags: IntArray) -> list[tuple[str, int]]:
    """Return (name of flag, number of entries that carry it), most frequent first, without zeros.

    Args:
        flags: flags of targets or of rejected candidates, shape (k,).

    Returns:
        Pairs of lower-case name and count.
    """
    counts = [(str(f.name).lower(), int(((flags & f.value) != 0).sum())) for f in Flag if f.value]
    return sorted((c for c in counts if c[1]), key=lambda c: (-c[1], c[0]))
