"""Groups of photographs of a folder that one camera took, with the camera data from their EXIF tags.

Photographs with the same make, model, serial number, lens, focal length and size form a group. It is divided
by the cameras that the names of the photographs propose, unless serial numbers or times of exposure
contradict them. Where names do not pair up, times of exposure may. Missing pixel sizes and focal lengths are
assumed, and the draft states so.
"""

from __future__ import annotations

import re
from collections import Counter, defaultdict
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from fnmatch import fnmatchcase
from glob import escape
from pathlib import PurePosixPath

import numpy as np

from sfm.model.remarks.remark import Remark, remark
from sfm.photographs.exif import Metadata
from sfm.products.drafting.camera_names import NamedCameras, cameras_in_names, divisions_by_names
from sfm.products.drafting.camera_times import USUAL_S, rig_of_times

FOCAL_PER_SIDE = 1.2  # assumed focal length over the longer side of the photograph
FULL_FRAME_MM = 36.0  # assumed longer side of the sensor
# Makers name fisheye lenses "EF8-15mm f/4L FISHEYE USM", "AF Fisheye Nikkor 16mm f/2.8D" or "7.5mm Fish-eye".
FISHEYE_NAME = re.compile("fish-?eye", re.IGNORECASE)
MIN_IN_GROUP = 2  # photographs of a camera; one with fewer is left out if another camera has so many
# Photographs of one moment differ by the tolerance of a rig, and by the whole seconds that EXIF data state.
MAX_APART_S = USUAL_S + 1.0
BY_TIMES = "exif"  # moment of `[[rig]]`: by EXIF times

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
    fisheye: str  # what shows that it has a fisheye lens, for people, else ""
    remarks: tuple[Remark, ...]  # on the photographs
    body: str = ""  # make, model and serial number; empty if the files state none


@dataclass(frozen=True)
class ProposedRig:
    """Cameras that seem to be mounted on one frame, because names or times of their photographs pair up."""

    cameras: tuple[str, ...]  # their names; the first is the reference
    moment: str  # of `[[rig]]`
    moments: int  # with a photograph of more than one camera
    example: tuple[str, ...]  # photographs of one moment
    tolerance_s: float = USUAL_S  # of EXIF times


@dataclass(frozen=True)
class Grouping:
    """The cameras of a folder, and photographs that a survey cannot use."""

    cameras: tuple[CameraGroup, ...]  # the camera with most photographs first
    left_out: tuple[tuple[str, str], ...]  # name, reason
    rig: ProposedRig | None = None


def group_photographs(
    metadata: dict[str, Metadata],
    sensor_width: SensorWidth = lambda make, model: None,
    *,
    others: Sequence[str] = (),
) -> Grouping:
    """Return the cameras that took the photographs, and the rig that they may be mounted on.

    Photographs with the same make, model, serial number, lens, focal length and size belong together, unless
    their names propose several cameras, see `cameras_in_names`.

    Args:
        metadata: metadata of every readable photograph, by its file name.
        sensor_width: looks up the sensor width if EXIF data do not give the pixel size.
        others: names of further files there, which no glob of a camera shall match.
    """
    named = cameras_in_names(sorted(metadata))
    if named is not None and _are_contradicted(named, metadata):
        named = None
    part = {} if named is None else dict(named.camera)
    kept, left_out = _divide(metadata, part)
    labels = _labels([metadata[names[0]] for names in kept], [part.get(names[0], "") for names in kept])
    rig = None if named is None else _rig(named, dict(zip(labels, kept, strict=True)))
    for division in () if rig is not None else (part, *divisions_by_names(sorted(metadata))):
        kept_then, left_out_then = _divide(metadata, division)
        labels_then = _labels(
            [metadata[names[0]] for names in kept_then], [division.get(names[0], "") for names in kept_then]
        )
        cameras = dict(zip(labels_then, kept_then, strict=True))
        timed = rig_of_times(cameras, metadata)
        if timed is not None:
            kept, left_out, labels = kept_then, left_out_then, labels_then
            shared = _of_one_moment(timed.moment, [cameras[camera] for camera in timed.cameras])
            example = max(shared, key=len)
            rig = ProposedRig(timed.cameras, BY_TIMES, len(shared), example, timed.tolerance_s)
            break
    return Grouping(
        tuple(
            _group(label, tuple(names), metadata, sensor_width, (*metadata, *others))
            for label, names in zip(labels, kept, strict=True)
        ),
        tuple(left_out),
        rig,
    )


def _divide(
    metadata: Mapping[str, Metadata], part: Mapping[str, str]
) -> tuple[list[list[str]], list[tuple[str, str]]]:
    """Return the photographs of each camera, most first, and those that are left out with the reason.

    part: what stands for the camera in the name of each photograph; none where it is missing.
    """
    groups: dict[tuple[object, ...], list[str]] = defaultdict(list)
    for name, exif in sorted(metadata.items()):
        camera = exif.make, exif.model, exif.serial, exif.lens, _rounded(exif.focal_mm), exif.size_px
        groups[*camera, part.get(name, "")].append(name)
    largest = max((len(names) for names in groups.values()), default=0)
    kept: list[list[str]] = []
    left_out: list[tuple[str, str]] = []
    for names in sorted(groups.values(), key=lambda names: (-len(names), names)):
        if len(names) >= MIN_IN_GROUP or largest < MIN_IN_GROUP:
            kept.append(names)
        else:
            left_out += [(name, _reason_left_out(metadata[name], metadata[kept[0][0]])) for name in names]
    return kept, left_out


def _are_contradicted(named: NamedCameras, metadata: Mapping[str, Metadata]) -> bool:
    """Return whether serial numbers or times contradict that the names give cameras of one moment.

    One camera took what the names give to several, or its photographs are not taken together: the clocks of
    cameras differ by a constant, and a camera that is carried on has no constant difference.
    """
    parts: dict[object, set[str]] = defaultdict(set)
    of: dict[str, dict[str, float]] = defaultdict(dict)
    for name, part in named.camera.items():
        exif = metadata[name]
        if exif.serial:
            parts[exif.make, exif.model, exif.serial].add(part)
        if exif.taken is not None:
            of[part][named.moment[name]] = exif.taken.timestamp()
    if any(len(of_one_body) > 1 for of_one_body in parts.values()):
        return True
    reference, *others = sorted(of.values(), key=len, reverse=True) or [{}]
    for times in others:
        ahead = np.array([times[moment] - reference[moment] for moment in times if moment in reference])
        if len(ahead) > 1 and (np.abs(ahead - np.median(ahead)) > MAX_APART_S).mean() > 0.5:
            return True
    return False


def _rig(named: NamedCameras, cameras: Mapping[str, Sequence[str]]) -> ProposedRig | None:
    """Return the rig of named cameras; None if a camera is not one group, or few photographs pair up."""
    of = {label: names for label, names in cameras.items() if names[0] in named.camera}
    parts = [named.camera[names[0]] for names in of.values()]
    if len(of) < 2 or len(set(parts)) < len(parts) or not named.pattern:
        return None
    shared = _of_one_moment(named.moment, [of[label] for label in sorted(of)])
    if 2 * sum(map(len, shared)) <= sum(map(len, of.values())):
        return None
    return ProposedRig(tuple(sorted(of)), named.pattern, len(shared), max(shared, key=len))


def _of_one_moment(moment: Mapping[str, str], cameras: Iterable[Sequence[str]]) -> list[tuple[str, ...]]:
    """Return the photographs of each moment that several photographs of cameras share."""
    together: dict[str, list[str]] = defaultdict(list)
    for names in cameras:
        for name in names:
            together[moment[name]].append(name)
    return [tuple(names) for names in together.values() if len(names) > 1]


def _group(
    label: str,
    names: tuple[str, ...],
    metadata: dict[str, Metadata],
    sensor_width: SensorWidth,
    everything: tuple[str, ...],
) -> CameraGroup:
    """Return a camera; everything: names of all files there."""
    first = metadata[names[0]]
    side = max(first.size_px)
    pixel: float | None = None
    pixel_source = ""
    if first.pixel_mm is not None:
        pixel, pixel_source = sum(first.pixel_mm) / 2, "EXIF data"
    elif first.make and first.model and (width := sensor_width(first.make, first.model)) is not None:
        pixel, pixel_source = width / side, f"{first.make} {first.model} in COLMAP's list of cameras"
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
        _globs(names, everything),
        first.size_px,
        (pixel, pixel),
        pixel_source,
        c,
        c_source,
        assumed,
        next(
            (
                f"EXIF data: {text}"
                for text in (first.lens, first.model)
                if text and FISHEYE_NAME.search(text)
            ),
            "",
        ),
        _remarks(label, {name: metadata[name] for name in names}),
        " ".join(filter(None, (first.make, first.model, first.serial))),
    )


def _remarks(camera: str, photographs: dict[str, Metadata]) -> tuple[Remark, ...]:
    """Return remarks on photographs of a camera that were resampled."""
    remarks = []
    resampled = {
        name: exif.taken_px
        for name, exif in photographs.items()
        if exif.taken_px and sorted(exif.taken_px) != sorted(exif.size_px)
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
    return tuple(remarks)


def _reason_left_out(alone: Metadata, main: Metadata) -> str:
    """Return why the only photograph of a camera is left out."""
    if alone.size_px == main.size_px[::-1] and (alone.make, alone.model) == (main.make, main.model):
        return "the only one stored upright; a photograph turned by a program has lost its camera"
    if alone.size_px != main.size_px:
        return (
            f"the only one of {alone.size_px[0]} x {alone.size_px[1]} px, the others have "
            f"{main.size_px[0]} x {main.size_px[1]} px"
        )
    if _rounded(alone.focal_mm) != _rounded(main.focal_mm):
        return f"the only one with c = {alone.focal_mm or 0:g} mm, the others have {main.focal_mm or 0:g} mm"
    camera = " ".join(filter(None, (alone.make, alone.model, alone.serial)))
    return f"the only one of camera {camera}" if camera else "the only one whose name is like this"


def _rounded(focal: float | None) -> float | None:
    return None if focal is None else float(f"{focal:.3g}")


def _labels(firsts: Sequence[Metadata], parts: Sequence[str]) -> list[str]:
    """Return unique names of the cameras: the part of the file names that stands for each, or the model."""
    models = [_word(exif.model or "") for exif in firsts]
    paths = [PurePosixPath(part).parts for part in parts]
    common = min(map(len, paths), default=0)
    differing = [j for j in range(common) if len({folders[j] for folders in paths}) > 1]
    if differing:  # without the folders that all of them have
        parts = ["/".join(folders[j] for j in differing) for folders in paths]
    plain = [
        part if part and not part.isdigit() else "-".join(filter(None, (model or (part and "camera"), part)))
        for model, part in zip(models, map(_word, parts), strict=True)
    ]
    plain = [name or "unnamed" for name in plain]
    total, seen = Counter(plain), Counter[str]()
    labels = []
    for name in plain:
        seen[name] += 1
        labels.append(name if total[name] == 1 else f"{name}-{seen[name]}")
    return labels


def _word(text: str) -> str:
    return re.sub(r"[^A-Za-z0-9]+", "-", text).strip("-").lower()


def _globs(names: tuple[str, ...], everything: tuple[str, ...]) -> tuple[str, ...]:
    """Return a glob that matches only these photographs, else their names."""
    prefix = _common_start(names).rstrip("0123456789") if len(names) > 1 else names[0]
    suffix = _common_start([name[::-1] for name in names])[::-1].lstrip("0123456789")
    endings = {name.rpartition(".")[2] for name in names}
    for ending in (f".{endings.pop()}" if len(endings) == 1 else "", suffix):
        glob = f"{escape(prefix)}*{escape(ending)}"
        # folder by folder, as when files are searched
        alike = (name for name in everything if name.count("/") == glob.count("/"))
        if ending and {name for name in alike if fnmatchcase(name, glob)} == set(names):
            return (glob,)
    return tuple(escape(name) for name in sorted(names))


def _common_start(names: Sequence[str]) -> str:
    first, last = min(names), max(names)
    length = next((k for k, (a, b) in enumerate(zip(first, last, strict=False)) if a != b), len(first))
    return first[:length]
