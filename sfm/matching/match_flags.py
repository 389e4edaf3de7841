"""Why matching gives no position: the flags of correlation and of least squares matching."""

from __future__ import annotations

from enum import IntFlag


class NccFlag(IntFlag):
    """Why correlation gives no position, one bit each."""

    NONE = 0
    FLAT_TEXTURE = 1 << 0  # template or search window without contrast
    OUTSIDE = 1 << 2  # the template reaches beyond its photograph, or the search window beyond the other
    AT_BORDER = 1 << 3  # the best place is at the border of the search window: it may lie outside
    LOW_CORRELATION = 1 << 4  # nothing alike in the search window
    AMBIGUOUS = 1 << 5  # the second-best place is nearly as good
    NOT_CONFIRMED = 1 << 6  # matching back leads elsewhere


class LsmFlag(IntFlag):
    """Why least squares matching gives no position, one bit each."""

    NONE = 0
    FLAT_TEXTURE = 1 << 0  # in some direction no more texture than noise
    DIVERGED = 1 << 1  # no solution within the steps allowed, or a patch turned inside out
    OUTSIDE = 1 << 2  # the window, or the margin of its kernel, reaches beyond a photograph
    TOO_FAR = 1 << 3  # farther from the start than allowed
    LOW_CORRELATION = 1 << 4  # converged on something that is not alike


# The same for compiled code, which knows no enumerations.
MATCHED, FLAT_TEXTURE, DIVERGED, OUTSIDE, TOO_FAR, LOW_CORRELATION = (int(f) for f in (0, 1, 2, 4, 8, 16))


def in_words(kind: type[LsmFlag] | type[NccFlag], flag: int) -> str:
    """Return the names of the flags set, in words; empty where none is."""
    return ", ".join(
        str(one.name).lower().replace("_", " ") for one in kind if one.value and flag & one.value
    )
