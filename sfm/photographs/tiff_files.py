"""TIFF files, decoded with their pixels as stored.

OpenCV turns the pixels of a TIFF file by its orientation, even if asked not to: upright and level photographs
of one camera would then not have one interior orientation. The library below it darkens pixels by their
transparency. Both follow from tags, so OpenCV is given a copy whose tags do not demand it.
"""

from __future__ import annotations

import struct

# Tag: the value that leaves the pixels as they are.
AS_STORED = {
    274: 1,  # Orientation: the first row is at the top
    338: 1,  # ExtraSamples: the colours are stored as they are shown
}
SHORT = 3  # type of both values
CLASSIC, BIG = 42, 43  # TIFF and BigTIFF, in the header


def without_display_tags(data: bytes) -> bytes:
    """Return a TIFF file whose decoder leaves the pixels as stored; other files as they are.

    Args:
        data: content of a file.

    Source: TIFF 6.0 (1992), sections 2 and 8.
    """
    order = {b"II": "<", b"MM": ">"}.get(data[:2])
    try:
        version = struct.unpack_from(f"{order}H", data, 2)[0] if order else 0
        if version == CLASSIC:
            first, count_format, entry, value_at = struct.unpack_from(f"{order}I", data, 4)[0], "H", 12, 8
        elif version == BIG:
            first, count_format, entry, value_at = struct.unpack_from(f"{order}Q", data, 8)[0], "Q", 20, 12
        else:
            return data
        count = struct.unpack_from(f"{order}{count_format}", data, first)[0]
        begin = first + struct.calcsize(f"{order}{count_format}")
        changed: bytearray | None = None
        for at in range(begin, min(begin + count * entry, len(data)), entry):
            tag, kind, value = struct.unpack_from(f"{order}HH{value_at - 4}xH", data, at)
            if kind == SHORT and value != AS_STORED.get(tag, value):
                changed = changed if changed is not None else bytearray(data)
                struct.pack_into(f"{order}H", changed, at + value_at, AS_STORED[tag])
    except struct.error:  # truncated, which the decoder reports
        return data
    return data if changed is None else bytes(changed)
