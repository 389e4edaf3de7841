"""What the normal equations may take of the memory of this computer."""

from __future__ import annotations

import os

from sfm.errors import GeometryError

SHARE = 0.75  # of the memory; the network, its blocks and other programs need some beside them
UNKNOWN = 8e9  # bytes where the system does not say what it has


def available_bytes() -> float:
    """Return how much memory normal equations may take."""
    if not hasattr(os, "sysconf") or "SC_PHYS_PAGES" not in os.sysconf_names:
        return SHARE * UNKNOWN
    return SHARE * os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")


def refuse_what_does_not_fit(size: float, unknowns: str) -> None:
    """Refuse normal equations that need more memory than there is.

    Args:
        size: bytes that they, their factor and its inverse take.
        unknowns: which unknowns need them, in words.

    Raises:
        GeometryError: it is more than `available_bytes`.
    """
    limit = available_bytes()
    if size > limit:
        raise GeometryError(
            f"adjustment: {unknowns} need {size / 1e9:.0f} GB when they are factored and inverted, at most "
            f"{limit / 1e9:.0f} GB are taken"
        )
