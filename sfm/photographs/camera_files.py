"""Files of telephones (HEIF) and cameras (raw), by pillow-heif and rawpy of the extra kolinear[photographs].

They are read as a JPEG is: pixels as stored by the sensor, never turned, with the tone curve of sRGB. A HEIF
file states how it is turned for display, which its decoder has applied and which is undone here: otherwise
upright and level photographs of one camera would not have one interior orientation. Raw files are developed
all alike, without automatic brightness, lens correction, or turning.
"""

from __future__ import annotations

import io
from dataclasses import dataclass
from functools import cache
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
from PIL import ExifTags, Image

from sfm.model.conventions import AnyArray

HEIF = (".heic", ".heif", ".hif")
RAW = (".3fr", ".arw", ".cr2", ".cr3", ".crw", ".dng", ".erf", ".iiq", ".kdc", ".mrw", ".nef", ".nrw", ".orf",
       ".pef", ".raf", ".raw", ".rw2", ".srw", ".x3f")  # fmt: skip
INSTALL = "pip install 'kolinear[photographs]'"
SRGB_GAMMA = (2.4, 12.92)  # power and slope at 0 of the tone curve of sRGB (IEC 61966-2-1)
# EXIF orientation by what a HEIF file does to its pixels: degrees counterclockwise, and mirrored axes.
ORIENTATION: dict[tuple[Any, ...], int] = {
    (): 1,
    (("imir", 1),): 2,
    (("irot", 180),): 3,
    (("imir", 0),): 4,
    (("irot", 270), ("imir", 1)): 5,
    (("irot", 270),): 6,
    (("irot", 270), ("imir", 0)): 7,
    (("irot", 90),): 8,
}


@dataclass(frozen=True)
class CameraHeader:
    """What the header of such a file states, as the header of a photograph that Pillow opens."""

    size: tuple[int, int]  # width and height as stored, px
    exif: Image.Exif
    xmp: bytes = b""

    @property
    def info(self) -> dict[str, Any]:
        """Further data by name."""
        return {"xmp": self.xmp}

    def getexif(self) -> Image.Exif:
        """Return the EXIF data."""
        return self.exif


def missing_library(path: Path) -> str:
    """Return the library that a file needs and that is not installed; empty for other files.

    Args:
        path: a file, known by its ending.
    """
    ending = path.suffix.lower()
    name, module = ("pillow-heif", "pillow_heif") if ending in HEIF else ("rawpy", "rawpy")
    return name if ending in (*HEIF, *RAW) and not is_installed(module) else ""


@cache
def is_installed(module: str) -> bool:
    """Return whether a library of the extra kolinear[photographs] is installed.

    Args:
        module: the module that the library is imported by.
    """
    return find_spec(module) is not None


def is_camera_file(path: Path) -> bool:
    """Return whether a file is of a telephone or a raw file, by its ending."""
    return path.suffix.lower() in (*HEIF, *RAW)


def header_of(path: Path, source: Path | io.BytesIO) -> CameraHeader:
    """Return the header of a file, without decoding its pixels.

    Args:
        path: the file, for its ending.
        source: the same, or its content.

    Raises:
        Exception: of many kinds, if the file is damaged.
    """
    if path.suffix.lower() not in HEIF:
        return _raw_header(source)
    image = _heif_image(source)
    turns, exif = _turns(image), Image.Exif()
    exif.load(image.info.get("exif") or b"")
    exif[ExifTags.Base.Orientation] = ORIENTATION.get(turns, 1)
    turned = sum(value for kind, value in turns if kind == "irot") % 180 != 0
    xmp = image.info.get("xmp")
    return CameraHeader(
        image.size[::-1] if turned else image.size, exif, xmp if isinstance(xmp, bytes) else b""
    )


def pixels_of(path: Path, data: bytes) -> AnyArray:
    """Return the pixels of a file as stored: red, green and blue (H, W, 3), or grey (H, W).

    Args:
        path: the file, for its ending.
        data: its content.

    Returns:
        Intensities with the tone curve of sRGB, uint8 or uint16.

    Raises:
        Exception: of many kinds, if the file is damaged.
    """
    if path.suffix.lower() in HEIF:
        image = _heif_image(io.BytesIO(data))
        pixels = np.asarray(image)
        for kind, value in reversed(_turns(image)):
            pixels = np.rot90(pixels, -value // 90) if kind == "irot" else np.flip(pixels, value)
        if pixels.ndim == 3:  # without transparency
            pixels = pixels[:, :, :3] if pixels.shape[2] >= 3 else pixels[:, :, 0]
        return np.ascontiguousarray(pixels)
    import rawpy

    with rawpy.imread(io.BytesIO(data)) as raw:
        developed = raw.postprocess(
            output_bps=16,
            gamma=SRGB_GAMMA,
            output_color=rawpy.ColorSpace.sRGB,
            use_camera_wb=True,
            no_auto_bright=True,
            user_flip=0,
        )
    return np.asarray(developed)


def _heif_image(source: Path | io.BytesIO) -> Any:
    """Return the primary image of a HEIF file, not decoded yet."""
    import pillow_heif

    file = pillow_heif.open_heif(source, convert_hdr_to_8bit=False)
    return file[file.primary_index]


def _turns(image: Any) -> tuple[tuple[str, int], ...]:
    """Return the rotations (deg, counterclockwise) and mirrored axes that the decoder applies, in order."""
    return tuple(step for step in image._c_image.transformations if step[0] in ("irot", "imir"))


def _raw_header(source: Path | io.BytesIO) -> CameraHeader:
    """Return the header of a raw file; its EXIF data are in a TIFF header, else in that of its preview."""
    import rawpy

    exif = Image.Exif()
    try:
        with source.open("rb") if isinstance(source, Path) else io.BytesIO(source.getvalue()) as file:
            exif.load_from_fp(file)
            for part in (ExifTags.IFD.Exif, ExifTags.IFD.GPSInfo):  # before the file is closed
                exif.get_ifd(part)
    except Exception:  # it is no TIFF file, or damaged: many kinds
        exif = Image.Exif()
    with rawpy.imread(str(source) if isinstance(source, Path) else source) as raw:
        size = raw.sizes.width, raw.sizes.height
        if not exif.get_ifd(ExifTags.IFD.Exif):
            try:
                preview = raw.extract_thumb()
            except rawpy.LibRawError:  # it has none, or of another format
                preview = None
            if preview is not None and isinstance(preview.data, bytes):  # a JPEG, else pixels
                try:
                    with Image.open(io.BytesIO(preview.data), formats=("JPEG",)) as image:
                        exif = image.getexif()
                except Exception:  # as above
                    exif = Image.Exif()
    directory = exif.get_ifd(ExifTags.IFD.Exif)
    # they state the picture that the camera would develop, some pixels smaller: nothing was resampled
    directory[ExifTags.Base.ExifImageWidth], directory[ExifTags.Base.ExifImageHeight] = size
    return CameraHeader(size, exif)
