"""Object points written as a PLY point cloud in text form.

Source: Turk, The PLY polygon file format (1994).
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from sfm.conventions import FloatArray
from sfm.errors import OutputError

SIGMAS = ("sx", "sy", "sz")
COLOURS = ("red", "green", "blue")


def write_ply(
    path: Path,
    xyz: FloatArray,
    *,
    names: tuple[str, ...] = (),
    sigma: FloatArray | None = None,
    colours: Sequence[tuple[int, int, int]] | None = None,
    unit: str = "",
) -> None:
    """Write points; those with NaN are left out.

    Args:
        path: the file; whoever wants it whole or not at all gives one of `sfm.files.whole_files`.
        xyz: coordinates, (n, 3).
        names: of the points, which follow as comments "name <id>" in their order; none without.
        sigma: standard deviations, (n, 3).
        colours: red, green and blue of each point, 0 to 255.
        unit: of lengths, for a comment.

    Raises:
        OutputError: a name has spaces that a comment does not keep.
    """
    if any(" ".join(name.split()) != name for name in names):
        raise OutputError("PLY: names of points cannot begin or end with a space or have two in a row")
    table = np.asarray(xyz) if sigma is None else np.hstack([xyz, sigma])
    kept = np.flatnonzero(np.isfinite(table).all(axis=1)).tolist()
    words = " ".join(unit.encode("ascii", "replace").decode().split())
    lines = [
        *("ply", "format ascii 1.0", f"comment kolinear, {words}" if words else "comment kolinear"),
        *(f"comment name {names[j]}" for j in kept if names),
        f"element vertex {len(kept)}",
        *(f"property double {one}" for one in ("x", "y", "z", *(() if sigma is None else SIGMAS))),
        *(f"property uchar {one}" for one in (COLOURS if colours else ())),
        "end_header",
    ]
    for j in kept:
        row = (*table[j].tolist(), *(colours[j] if colours else ()))
        lines.append(" ".join(map(repr, row)))
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
