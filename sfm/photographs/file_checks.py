"""Files of photographs are untrusted: what they claim to be is checked before memory is taken for it."""

from __future__ import annotations

import io
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from threading import Lock

from PIL import Image

from sfm.errors import PhotographError

# warnings.catch_warnings is not safe in threads, and photographs are read in several.
_PILLOW = Lock()

FORMATS = ("JPEG", "PNG", "TIFF", "BMP", "PPM", "WEBP")  # by the names of Pillow, which finds none unasked
Image.init()
# Endings of what cameras and telephones write and is not read, and what makes photographs of it.
PHONE = (".heic", ".heif", ".hif", ".avif")
RAW = (".3fr", ".arw", ".cr2", ".cr3", ".crw", ".dng", ".erf", ".iiq", ".kdc", ".mrw", ".nef", ".nrw", ".orf",
       ".pef", ".raf", ".raw", ".rw2", ".srw", ".x3f")  # fmt: skip
MAX_FILE_BYTES = 2**30
MAX_PIXELS = 250_000_000  # the largest aerial scans; digital backs have 151 million
# A larger picture in fewer bytes is a decompression bomb; one sole grey value is 250 px per byte in a JPEG.
BOMB_PIXELS, BOMB_PX_PER_BYTE = 16_000_000, 500
MAX_SCANNED_PIXELS = 2_500_000_000  # pixels times scans of a progressive JPEG, some 20 s of decoding


def read_bytes(path: Path) -> bytes:
    """Return the content of a photograph's file.

    Raises:
        PhotographError: no such file, an empty one, or more than a photograph can have.
    """
    _refuse_unconverted(path)
    try:
        if path.exists() and not path.is_file():  # reading a pipe would never end
            raise PhotographError(f"{path.name}: not a file, a photograph is needed")
        if path.stat().st_size > MAX_FILE_BYTES:
            raise PhotographError(
                f"{path.name}: {path.stat().st_size} bytes, at most {MAX_FILE_BYTES} are read"
            )
        data = path.read_bytes()
    except OSError as error:
        raise PhotographError(f"{path.name}: {_reason(path, error)}") from error
    if not data:
        raise PhotographError(f"{path.name}: the file is empty")
    return data


def conversion_of(path: Path) -> str:
    """Return what a file is that must be converted first, by its ending, and how; empty for all others."""
    if path.suffix.lower() in PHONE:
        return (
            "a HEIF file, which is not read; convert all at full size and quality, such as with "
            "heif-convert -q 100 IN.heic OUT.jpg"
        )
    if path.suffix.lower() in RAW:
        return (
            "a raw file, which is not read; develop all alike to TIFF, without lens correction, cropping or "
            "turning, such as with dcraw -T -t 0 FILE"
        )
    return ""


def _refuse_unconverted(path: Path) -> None:
    """Refuse files that must be converted first; some raw files would be read as their small preview."""
    if words := conversion_of(path):
        raise PhotographError(f"{path.name}: {words}")


@contextmanager
def opened_header(path: Path, source: Path | io.BytesIO) -> Iterator[Image.Image]:
    """Open the header of a photograph; nothing is decoded.

    Raises:
        PhotographError: no such file, no photograph of a known format, or one that claims to be too large.
    """
    _refuse_unconverted(path)
    with _PILLOW, warnings.catch_warnings(action="ignore"):
        try:
            if source is path and path.exists() and not path.is_file():  # reading a pipe would never end
                raise PhotographError(f"{path.name}: not a file, a photograph is needed")
            image = _unbounded_open(source)
        except PhotographError:
            raise
        except Exception as error:  # Pillow stumbles over damaged headers in many ways
            raise PhotographError(f"{path.name}: {_reason(path, error)}") from error
        with image:
            if image.width * image.height > MAX_PIXELS:
                raise PhotographError(
                    f"{path.name}: {image.width} x {image.height} px; "
                    f"photographs of at most {MAX_PIXELS / 1e6:.0f} million pixels are read"
                )
            yield image


def _unbounded_open(source: Path | io.BytesIO) -> Image.Image:
    """Open a header without the limit of Pillow, which is below that of aerial scans."""
    limit = Image.MAX_IMAGE_PIXELS
    Image.MAX_IMAGE_PIXELS = None
    try:
        return Image.open(source, formats=FORMATS)
    finally:
        Image.MAX_IMAGE_PIXELS = limit


def refuse_bomb(path: Path, size: tuple[int, int], data: bytes) -> None:
    """Refuse a file that claims far more pixels than its bytes can hold, or that takes too long to decode.

    Raises:
        PhotographError: more pixels than the bytes can hold, or too many scans.
    """
    pixels = size[0] * size[1]
    if pixels > BOMB_PIXELS and pixels > BOMB_PX_PER_BYTE * len(data):
        raise PhotographError(
            f"{path.name}: {size[0]} x {size[1]} px in {len(data)} bytes is no photograph; "
            f"a file of that size has at least {pixels // BOMB_PX_PER_BYTE} bytes"
        )
    scans = data.count(b"\xff\xda") if data.startswith(b"\xff\xd8") else 1
    if scans * pixels > MAX_SCANNED_PIXELS:
        raise PhotographError(f"{path.name}: a JPEG of {scans} scans; save it as a baseline JPEG")


def refuse_truncated(path: Path, data: bytes) -> None:
    """Refuse JPEG and PNG files whose end is missing; OpenCV would return them half grey.

    Raises:
        PhotographError: the end is missing.
    """
    if data.startswith(b"\xff\xd8"):
        at = 2
        while at + 4 <= len(data) and data[at] == 0xFF and data[at + 1] != 0xDA:  # segments before the scan
            if data[at + 1] == 0xFF:  # fill byte
                at += 1
            else:
                at += 2 + int.from_bytes(data[at + 2 : at + 4], "big")
        # Inside a scan 0xff is always followed by 0 or a restart marker, so this is the end of the image.
        complete = data.find(b"\xff\xd9", at) >= 0
    elif data.startswith(b"\x89PNG\r\n\x1a\n"):
        complete = _png_is_whole(data)
    else:
        return  # the decoder itself refuses truncated TIFF files
    if not complete:
        raise PhotographError(f"{path.name}: the file is truncated, its end is missing ({len(data)} bytes)")


def _png_is_whole(data: bytes) -> bool:
    """Whether the chunks of a PNG lie within the file; OpenCV takes memory for what they claim."""
    at = 8
    while at + 12 <= len(data):
        kind = data[at + 4 : at + 8]
        at += 12 + int.from_bytes(data[at : at + 4], "big")
        if kind == b"IEND":
            return at <= len(data)
    return False


def _reason(path: Path, error: Exception) -> str:
    if not path.exists():
        return f"no such file in {path.parent}"
    if isinstance(error, OSError) and error.strerror:
        return error.strerror
    return "not a photograph that can be decoded"
