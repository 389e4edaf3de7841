"""Photographs drawn anew as a view shows them, with their bits, colours and EXIF data."""

from __future__ import annotations

import io
from pathlib import Path

import cv2
import numpy as np
from PIL import ExifTags, Image

from sfm.model.conventions import AnyArray
from sfm.model.errors import PhotographError
from sfm.photographs.camera_files import CameraHeader
from sfm.photographs.exif import (
    opened_header,
    read_bytes,
    refuse_bomb,
    refuse_truncated,
    stored_size,
)
from sfm.photographs.reading import decoded_as_stored
from sfm.products.undistorting.views import View

QUALITY = 97  # percent, of JPEG; noise of a new compression is below that of the photograph
MAX_SIDE_PX = 32766  # that cv2.remap draws
COLOURS = ("L", "RGB", "RGBA")  # whose colour profile suits what OpenCV decodes
# Tags of TIFF that describe the photograph, and not how its pixels are stored.
_TAGS = ExifTags.Base
OF_PHOTOGRAPH = {
    *(_TAGS.Make, _TAGS.Model, _TAGS.ImageDescription, _TAGS.Orientation, _TAGS.XResolution),
    *(_TAGS.YResolution, _TAGS.ResolutionUnit, _TAGS.Software, _TAGS.DateTime, _TAGS.Artist, _TAGS.Copyright),
}
INTERPOLATION = cv2.INTER_CUBIC


class UndistortedPhotographs:
    """Draws photographs of some cameras, whose places are computed once for each view."""

    def __init__(self) -> None:
        self._view: View | None = None
        self._places: tuple[AnyArray, AnyArray] | None = None
        self.count = 0
        """photographs drawn"""
        self.without_exif: list[str] = []
        """names of photographs whose EXIF data could not be kept"""

    def draw(self, path: Path, view: View, out: Path) -> None:
        """Draw a photograph as a view shows it.

        Args:
            path: the photograph.
            view: of the camera that took it.
            out: new file with the same ending.

        Raises:
            PhotographError: it cannot be read, or has another size than the camera.
            OSError: the new file cannot be written.
        """
        if self._view is not view or self._places is None:
            self._view, self._places = view, view.places()
        data = read_bytes(path)
        refuse_truncated(path, data)
        with opened_header(path, io.BytesIO(data)) as header:
            if isinstance(header, CameraHeader):
                raise PhotographError(f"{path.name}: this kind cannot be written as {out.suffix}")
            size, kind = stored_size(header), header.format or ""
            exif = header.info.get("exif") or _exif(header)
            icc = header.info.get("icc_profile") if header.mode in COLOURS else None
        if max(size) > MAX_SIDE_PX:
            raise PhotographError(f"{path.name}: {size[0]} x {size[1]} px, at most {MAX_SIDE_PX} on a side")
        refuse_bomb(path, size, data)
        pixels = decoded_as_stored(path, data, cv2.IMREAD_UNCHANGED)
        if pixels.dtype not in (np.uint8, np.uint16):
            raise PhotographError(f"{path.name}: found {pixels.dtype} intensities, expected 8 or 16 bit")
        if size != view.former.size_px:
            needed = f"{view.former.size_px[0]} x {view.former.size_px[1]}"
            raise PhotographError(
                f"{path.name}: {size[0]} x {size[1]} px, camera {view.former.name} was calibrated with "
                f"photographs of {needed} px; needed photographs of that size"
            )
        x, y = self._places
        self.count += 1
        drawn = cv2.remap(pixels, x, y, INTERPOLATION, borderMode=cv2.BORDER_CONSTANT, borderValue=0)
        if drawn.dtype == np.uint8:
            # in the order of others, red, green, blue and alpha
            colours = (
                drawn
                if drawn.ndim == 2
                else np.ascontiguousarray(drawn[:, :, (2, 1, 0, 3)[: drawn.shape[2]]])
            )
            options: dict[str, object] = {"exif": exif} if exif else {}
            options |= {"icc_profile": icc} if icc else {}
            if kind in ("JPEG", "MPO", "WEBP"):
                options |= {"quality": QUALITY} | ({} if kind == "WEBP" else {"subsampling": 0})
            Image.fromarray(colours).save(out, "JPEG" if kind == "MPO" else kind, **options)
            return
        if exif:
            self.without_exif.append(path.name)
        done, encoded = cv2.imencode(out.suffix, drawn)
        if not done:
            raise PhotographError(
                f"{path.name}: a photograph of {drawn.dtype} cannot be written as {out.suffix}"
            )
        out.write_bytes(encoded.tobytes())


def _exif(header: Image.Image) -> bytes:
    """Return the EXIF data of a file without a block of its own, as of TIFF."""
    found, kept = header.getexif(), Image.Exif()
    for tag in OF_PHOTOGRAPH & set(found):
        kept[tag] = found[tag]
    for directory in (ExifTags.IFD.Exif, ExifTags.IFD.GPSInfo):
        kept.get_ifd(directory).update(found.get_ifd(directory))
        if kept.get_ifd(directory):
            kept[directory] = kept.get_ifd(directory)
    return kept.tobytes() if len(kept) else b""
