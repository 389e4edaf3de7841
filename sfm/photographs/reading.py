"""Reading of the pixels of photographs."""

from __future__ import annotations

import io
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from pathlib import Path
from typing import overload

import cv2
import numpy as np

from sfm.model.arguments import checked_arguments
from sfm.model.conventions import AnyArray
from sfm.model.errors import PhotographError
from sfm.photographs.camera_files import HEIF, RAW, is_camera_file, pixels_of
from sfm.photographs.exif import (
    opened_header,
    read_bytes,
    refuse_bomb,
    refuse_truncated,
    stored_size,
)
from sfm.photographs.tiff_files import without_display_tags

# PhotographError states the fault of a file; OpenCV's warnings on private TIFF tags do not help.
cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)

PLAIN = (".jpg", ".jpeg", ".png", ".tif", ".tiff", ".bmp", ".ppm", ".pgm", ".webp")
SUFFIXES = (*PLAIN, *HEIF, *RAW)
CHANNELS = ("luminance", "red", "green", "blue")
# IEC 61966-2-1 (sRGB): linear below this signal, a power law above it.
SRGB_LINEAR, SRGB_SLOPE, SRGB_OFFSET, SRGB_POWER = 0.04045, 12.92, 0.055, 2.4


# What was decoded, by file and channel, while this thread works on one photograph; None at other times.
_decoded: ContextVar[dict[tuple[Path, str], AnyArray] | None] = ContextVar("decoded", default=None)


@contextmanager
def decoding_once() -> Iterator[None]:
    """Decode every file once a channel, however often this thread reads it inside; then all pixels are freed.

    All who read a file receive the same array, which they leave as it is.
    """
    before = _decoded.set({})
    try:
        yield
    finally:
        _decoded.reset(before)


@checked_arguments()
def read_photograph(path: str | Path, *, channel: str = "luminance") -> AnyArray:
    """Read one photograph as stored, with all bits; it is never rotated by its EXIF orientation.

    Args:
        path: JPEG, TIFF, PNG or another format that OpenCV reads; HEIF or raw with kolinear[photographs].
        channel: luminance (Rec. 601), red, green or blue; all are the same for grey photographs.

    Returns:
        Intensities, (H, W), uint8 or uint16.

    Raises:
        PhotographError: the file does not exist, is not a photograph, is truncated, or has neither 8 nor 16
            bit.

    Example:
        >>> import tempfile
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     _ = cv2.imwrite(f"{folder}/a.png", np.full((3, 4), 200, np.uint8))
        ...     photograph = read_photograph(f"{folder}/a.png")
        >>> photograph.shape, photograph.dtype
        ((3, 4), dtype('uint8'))
    """
    path = Path(path)
    if channel not in CHANNELS:
        raise PhotographError(f"{path.name}: channel {channel!r}, expected one of {', '.join(CHANNELS)}")
    decoded = _decoded.get()
    if decoded is None:
        return _decode(path, channel)
    if (path, channel) not in decoded:
        decoded[path, channel] = _decode(path, channel)
    return decoded[path, channel]


def read_mask(path: Path) -> AnyArray:
    """Read a picture whose header states the size of a photograph; masks compress better than photographs.

    Args:
        path: a file whose size is known to be that of its photograph.

    Returns:
        Intensities, (H, W), uint8 or uint16.

    Raises:
        PhotographError: as `read_photograph`.
    """
    return _decode(path, "luminance", may_be_plain=True)


def read_for_display(path: Path, *, shrink: int = 1) -> AnyArray:
    """Read a photograph as a screen shows it, in colour and as stored; see `read_photograph`.

    Args:
        path: JPEG, TIFF, PNG or another format that OpenCV reads; HEIF or raw with kolinear[photographs].
        shrink: 1, 2, 4 or 8: the sides are divided by it. A JPEG is decoded at that size, which saves most of
            the time.

    Returns:
        Blue, green and red, (H, W, 3), uint8.

    Raises:
        PhotographError: as `read_photograph`.
    """
    flags = {
        1: cv2.IMREAD_COLOR,
        2: cv2.IMREAD_REDUCED_COLOR_2,
        4: cv2.IMREAD_REDUCED_COLOR_4,
        8: cv2.IMREAD_REDUCED_COLOR_8,
    }
    data = read_bytes(path)
    with opened_header(path, io.BytesIO(data)) as header:
        size = stored_size(header)
    refuse_bomb(path, size, data)
    if not is_camera_file(path):
        return decoded_as_stored(path, data, flags[shrink])
    pixels = _camera_pixels(path, data)
    if pixels.dtype == np.uint16:
        pixels = (pixels >> 8).astype(np.uint8)
    pixels = cv2.cvtColor(pixels, cv2.COLOR_GRAY2BGR if pixels.ndim == 2 else cv2.COLOR_RGB2BGR)
    if shrink > 1:
        shown = -(-pixels.shape[1] // shrink), -(-pixels.shape[0] // shrink)
        pixels = cv2.resize(pixels, shown, interpolation=cv2.INTER_AREA)
    return np.asarray(pixels)


def decoded_as_stored(path: Path, data: bytes, flags: int) -> AnyArray:
    """Return the pixels of a file as OpenCV reads it, but never turned.

    Args:
        path: the photograph, for error messages.
        data: content of the file.
        flags: those of `cv2.imdecode`.

    Raises:
        PhotographError: it cannot be decoded.
    """
    try:
        image = cv2.imdecode(
            np.frombuffer(without_display_tags(data), np.uint8), flags | cv2.IMREAD_IGNORE_ORIENTATION
        )
    except cv2.error:
        image = None
    if image is None:
        raise PhotographError(f"{path.name}: not a photograph that can be decoded ({len(data)} bytes)")
    return image


def _camera_pixels(path: Path, data: bytes) -> AnyArray:
    """Return the pixels of a file of a telephone or a raw file, see `pixels_of`."""
    try:
        return pixels_of(path, data)
    except Exception as error:  # the libraries fail on damaged files in many ways
        raise PhotographError(
            f"{path.name}: not a photograph that can be decoded ({len(data)} bytes)"
        ) from error


def _decode(path: Path, channel: str, *, may_be_plain: bool = False) -> AnyArray:
    """Return the pixels of a file, as `read_photograph` does.

    may_be_plain: few bytes may stand for many pixels.
    """
    data = read_bytes(path)
    refuse_truncated(path, data)
    with opened_header(path, io.BytesIO(data)) as header:
        size = stored_size(header)
    if not may_be_plain:
        refuse_bomb(path, size, data)
    if is_camera_file(path):
        pixels = _camera_pixels(path, data)
        if pixels.ndim != 2 and channel == "luminance":
            pixels = np.asarray(cv2.cvtColor(pixels, cv2.COLOR_RGB2GRAY))
        elif pixels.ndim != 2:
            pixels = np.ascontiguousarray(pixels[:, :, ("red", "green", "blue").index(channel)])
        return _of_size(path, pixels, size)
    colour = cv2.IMREAD_GRAYSCALE if channel == "luminance" else cv2.IMREAD_COLOR
    image = _of_size(path, decoded_as_stored(path, data, colour | cv2.IMREAD_ANYDEPTH), size)
    if image.dtype not in (np.uint8, np.uint16):
        raise PhotographError(f"{path.name}: found {image.dtype} intensities, expected 8 or 16 bit")
    if image.ndim == 3:
        image = np.ascontiguousarray(image[:, :, {"blue": 0, "green": 1, "red": 2}[channel]])
    return image


def _of_size(path: Path, image: AnyArray, size: tuple[int, int]) -> AnyArray:
    """Return pixels; refuse those of another size than the header states."""
    if image.shape[1::-1] != size:
        decoded = f"{image.shape[1]} x {image.shape[0]}"
        raise PhotographError(f"{path.name}: {decoded} px, its header states {size[0]} x {size[1]}")
    return image


class PhotographFiles(Sequence[AnyArray]):
    """Photographs that are read from their files on every access, and not kept in memory."""

    def __init__(self, paths: Sequence[Path]) -> None:
        """Take the paths of the files, without reading them."""
        self._paths = tuple(paths)

    def __len__(self) -> int:
        return len(self._paths)

    @overload
    def __getitem__(self, k: int) -> AnyArray: ...
    @overload
    def __getitem__(self, k: slice) -> PhotographFiles: ...
    def __getitem__(self, k: int | slice) -> AnyArray | PhotographFiles:
        """Return one photograph, (H, W), see `read_photograph`; a slice gives `PhotographFiles`."""
        return PhotographFiles(self._paths[k]) if isinstance(k, slice) else read_photograph(self._paths[k])


def linearise_srgb(photograph: AnyArray) -> AnyArray:
    """Return the linear light of a photograph with the tone curve of sRGB, as uint16.

    A tone curve moves the half-bright position of an edge, inwards around dark targets. Centres of circles
    are not affected, but corners of tags are.

    Args:
        photograph: intensities, (H, W), uint8 or uint16.

    Source: IEC 61966-2-1.
    """
    scale = np.iinfo(photograph.dtype).max
    signal = np.arange(scale + 1) / scale
    power = ((signal + SRGB_OFFSET) / (1 + SRGB_OFFSET)) ** SRGB_POWER
    light = np.where(signal <= SRGB_LINEAR, signal / SRGB_SLOPE, power)
    return np.asarray(np.rint(65535 * light).astype(np.uint16)[photograph])
