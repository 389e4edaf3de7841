"""Groups of photographs of a folder that one camera took, with the camera data from their EXIF tags.

Photographs with the same make, model, serial number, lens, focal length and size form a group. Missing pixel
sizes and focal lengths are assumed, and the draft states so.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from fnmatch import fnmatchcase
from glob import escape

from sfm.photographs.exif import Metadata
from sfm.remarks.remark import Remark, remark

FOCAL_PER_SIDE = 1.2  # assumed focal length over the longer side of the photograph
FULL_FRAME_MM = 36.0  # assumed longer side of the sensor
# Makers name fisheye lenses "EF8-15mm f/4L FISHEYE USM", "AF Fisheye Nikkor 16mm f/2.8D" or "7.5mm Fish-eye".
FISHEYE_NAME = re.compile("fish-?eye", re.IGNORECASE)
MIN_IN_GROUP = 2  # photographs of a camera; one with fewer is left out if another camera has so many

SensorWidth = Callable[[str, str], float | None]
"""width of the sensor (mm) of a camera by make and model; None where it is unknown"""


@dataclass(frozen=True)
class CameraGroup:
    """Photographs of one camera in one setting, and the data of this camera."""

    name: str
    photographs: tuple[str, ...]  # file names
    globs: tuple[str, ...]  # match these and no other photograph of the folder
    size_px: tuple[int, int]
    pixel_mm: tuple[float, float]
    pixel_source: str  # source of the pixel size, for people
    c_mm: float
    c_source: str
    assumed: bool  # whether pixel size or principal distance is only assumed
    fisheye: str  # name of the lens or camera if it shows a fisheye lens, else ""
    remarks: tuple[Remark, ...]  # on the photographs


@dataclass(frozen=True)
class Grouping:
    """The cameras of a folder, and photographs that a survey cannot use."""

    cameras: tuple[CameraGroup, ...]  # the camera with most photographs first
    left_out: tuple[tuple[str, str], ...]  # name, reason


def group_photographs(
    metadata: dict[str, Metadata], sensor_width: SensorWidth = lambda make, model: None
) -> Grouping:
    """Return the cameras that took the photographs.

    Photographs with the same make, model, serial number, lens, focal length and size belong together. If no
    file states the maker, the part of the file name before its last number identifies the camera.

    Args:
        metadata: metadata of every readable photograph, by its file name.
        sensor_width: looks up the sensor width if EXIF data do not give the pixel size.
    """
    groups: dict[tuple[object, ...], list[str]] = {}
    by_name = not any(one.make for one in metadata.values())
    for name, one in sorted(metadata.items()):
        key = (one.make, one.model, one.serial, one.lens, _rounded(one.focal_mm), one.size_px)
        groups.setdefault((*key, _name_before_number(name) if by_name else ""), []).append(name)
    largest = max((len(names) for names in groups.values()), default=0)
    kept, left_out = [], []
    for names in sorted(groups.values(), key=lambda names: (-len(names), names)):
        if len(names) >= MIN_IN_GROUP or largest < MIN_IN_GROUP:
            kept.append(names)
        else:
            left_out += [(name, _reason_left_out(metadata[name], metadata[kept[0][0]])) for name in names]
    labels = _labels([metadata[names[0]] for names in kept])
    return Grouping(
        tuple(
            _group(label, tuple(names), metadata, sensor_width)
            for label, names in zip(labels, kept, strict=True)
        ),
        tuple(left_out),
    )


def _group(
    label: str, names: tuple[str, ...], metadata: dict[str, Metadata], sensor_width: SensorWidth
) -> CameraGroup:
    first = metadata[names[0]]
    pixel, pixel_source = _pixel(first, sensor_width)
    side = max(first.size_px)
    assumed = pixel is None
    if first.focal_mm is not None:
        c, c_source = first.focal_mm, "EXIF focal length"
        if pixel is None:
            pixel = c / (FOCAL_PER_SIDE * side)
            pixel_source = f"ASSUMED from a focal length of {FOCAL_PER_SIDE:g} times the longer side"
    else:
        if pixel is None:
            pixel = FULL_FRAME_MM / side
            pixel_source = f"ASSUMED from a sensor {FULL_FRAME_MM:g} mm wide"
        c = FOCAL_PER_SIDE * side * pixel
        c_source = f"ASSUMED, {FOCAL_PER_SIDE:g} times the longer side; the adjustment finds it"
        assumed = True
    return CameraGroup(
        label,
        names,
        _globs(names, tuple(metadata)),
        first.size_px,
        (pixel, pixel),
        pixel_source,
        c,
        c_source,
        assumed,
        next((one for one in (first.lens, first.model) if one and FISHEYE_NAME.search(one)), ""),
        _remarks(label, {name: metadata[name] for name in names}),
    )


def _pixel(one: Metadata, sensor_width: SensorWidth) -> tuple[float | None, str]:
    """Return the side of a pixel, mm, and its source."""
    if one.pixel_mm is not None:
        return sum(one.pixel_mm) / 2, "EXIF data"
    width = sensor_width(one.make, one.model) if one.make and one.model else None
    if width is not None:
        return width / max(one.size_px), f"{one.make} {one.model} in COLMAP's list of cameras"
    return None, ""


def _remarks(camera: str, photographs: dict[str, Metadata]) -> tuple[Remark, ...]:
    """Return remarks on photographs of a camera that were resampled or are marked as turned."""
    remarks = []
    resampled = {
        name: one.taken_px
        for name, one in photographs.items()
        if one.taken_px and sorted(one.taken_px) != sorted(one.size_px)
    }
    if resampled:
        name, taken = next(iter(resampled.items()))
        size = photographs[name].size_px
        remarks.append(
            remark(
                "photographs_resampled",
                camera=camera,
                photographs=list(resampled),
                size=f"{size[0]} x {size[1]} px",
                taken=f"{taken[0]} x {taken[1]} px",
            )
        )
    turned = [name for name, one in photographs.items() if one.orientation != 1]
    if turned:
        remarks.append(remark("photographs_marked_as_turned", camera=camera, photographs=turned))
    return tuple(remarks)


def _reason_left_out(one: Metadata, main: Metadata) -> str:
    """Return why the only photograph of a camera is left out."""
    if one.size_px == main.size_px[::-1] and (one.make, one.model) == (main.make, main.model):
        return "the only one stored upright; a photograph turned by a program has lost its camera"
    if one.size_px != main.size_px:
        return (
            f"the only one of {one.size_px[0]} x {one.size_px[1]} px, the others have "
            f"{main.size_px[0]} x {main.size_px[1]} px"
        )
    if _rounded(one.focal_mm) != _rounded(main.focal_mm):
        return f"the only one with c = {one.focal_mm or 0:g} mm, the others have {main.focal_mm or 0:g} mm"
    return f"the only one of camera {one.make or ''} {one.model or ''} {one.serial or ''}".rstrip()


def _rounded(focal: float | None) -> float | None:
    return None if focal is None else float(f"{focal:.3g}")


def _name_before_number(name: str) -> str:
    """Return the part of a name before its last number; "" if it contains a date."""
    found = re.fullmatch(r"(.*?)\d+(\D*)", name)
    prefix = found[1] if found else ""
    return "" if re.search(r"(19|20)\d{6}", prefix) else prefix


def _labels(firsts: list[Metadata]) -> list[str]:
    """Return unique names of the cameras."""
    words = [re.sub(r"[^A-Za-z0-9]+", "-", one.model or "").strip("-").lower() for one in firsts]
    plain = [word or "unnamed" for word in words]
    total, seen = Counter(plain), Counter[str]()
    labels = []
    for name in plain:
        seen[name] += 1
        labels.append(name if total[name] == 1 else f"{name}-{seen[name]}")
    return labels


def _globs(names: tuple[str, ...], everything: tuple[str, ...]) -> tuple[str, ...]:
    """Return a glob that matches only these photographs, else their names."""
    first, last = min(names), max(names)
    start = 0
    while start < min(len(first), len(last)) and first[start] == last[start]:
        start += 1
    prefix = first[:start].rstrip("0123456789") if start < len(first) else first
    endings = {name.rpartition(".")[2] for name in names}
    if len(endings) == 1:
        glob = f"{escape(prefix)}*.{escape(endings.pop())}"
        if {name for name in everything if fnmatchcase(name, glob)} == set(names):
            return (glob,)
    return tuple(escape(name) for name in sorted(names))
