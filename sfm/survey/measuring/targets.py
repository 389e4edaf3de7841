"""Targets of all photographs of a survey, measured in parallel.

Copies of photographs are left out. Photographs of another size than the others of their camera get a separate
camera or are left out.
"""

from __future__ import annotations

import hashlib
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from contextlib import suppress
from dataclasses import dataclass, replace
from glob import escape
from pathlib import Path
from typing import TypeVar

import numpy as np

from sfm.judgement.survey_result import FailedImage
from sfm.model.conventions import AnyArray, BoolArray, FloatArray
from sfm.model.display import counted, listed
from sfm.model.errors import GeometryError, PhotographError
from sfm.model.remarks.remark import Remark, remark
from sfm.photographs.exif import Metadata, read_metadata
from sfm.photographs.masks import Masks
from sfm.photographs.reading import linearise_srgb, read_photograph
from sfm.runtime.faults import working_on
from sfm.runtime.progress import SILENT, Progress
from sfm.survey.inputs.cameras import start_cameras
from sfm.survey.inputs.checks.copies import MIN_COMMON
from sfm.survey.inputs.measurements import MeasuredPhotographs, PhotographList
from sfm.survey.inputs.settings import CameraSettings, TargetSettings
from sfm.survey.inputs.survey import Survey
from sfm.survey.measuring.measured_store import TARGETS, MeasuredStore, content_hash, measured_once
from sfm.targets.codes.concentric import ConcentricFamily
from sfm.targets.codes.plates import PlateFamily, PlateGroup, TargetFamily
from sfm.targets.codes.tags import TagFamily
from sfm.targets.detect import Targets, find_targets

MIN_OWN = 3  # photographs of another size that justify a separate camera
# Largest relative difference of the aspect ratio of a resampled photograph.
MAX_ASPECT_DIFFERENCE = 0.005
RESAMPLED, UPRIGHT, CROPPED = "resampled", "stored upright", "cropped or from another sensor"
Size = tuple[int, int]
T = TypeVar("T")
MIN_PHOTOGRAPHS = 2
MAX_LISTED = 5  # photographs that an error message lists


def measure_photographs(
    survey: Survey,
    photographs: PhotographList,
    *,
    jobs: int = 1,
    store: MeasuredStore | None = None,
    progress: Progress = SILENT,
) -> MeasuredPhotographs:
    """Read the photographs, and find, measure and decode their targets.

    A photograph that cannot be read does not stop the others. It is listed with the reason, and so is a copy
    of another photograph.

    Args:
        survey: states the targets and the camera data.
        photographs: files of the photographs.
        jobs: number of photographs processed in parallel.
        store: store of earlier measurements; None to measure everything anew.
        progress: receives every photograph.

    Raises:
        GeometryError: fewer than two readable photographs.
        PhotographError: photographs of different sizes have the same camera.
        SurveyFileError: the code table or the start values of a camera are unusable.
    """
    family, masks = survey.family, Masks(survey.masks)
    name_of = dict(zip(photographs.paths, photographs.names, strict=True))

    def read_and_measure(path: Path) -> tuple[Metadata, Targets, bool]:
        targets, stored = measure_photograph(
            path, survey.targets, family, store, name=name_of[path], masks=masks
        )  # first: it reports faults of a file best
        return read_metadata(path), targets, stored

    measured, failed = each_photograph(
        photographs,
        read_and_measure,
        places=lambda read: read[1].xy,
        jobs=jobs,
        progress=progress,
    )
    order = sorted(measured)
    names = tuple(photographs.names[k] for k in order)
    camera = photographs.camera[order]
    return MeasuredPhotographs(
        names,
        tuple(photographs.paths[k] for k in order),
        camera,
        start_cameras(
            survey.cameras,
            survey.source,
            tuple(measured[k][0] for k in order),
            camera,
            names,
            survey.start_cameras,
        ),
        tuple(measured[k][1] for k in order),
        failed,
        tuple(measured[k][2] for k in order),
    )


def measure_photograph(
    path: Path,
    settings: TargetSettings,
    family: TargetFamily | None,
    store: MeasuredStore | None = None,
    *,
    name: str = "",
    masks: Masks = Masks(),
) -> tuple[Targets, bool]:
    """Return the targets of one photograph, and whether they were read from the store.

    The pixels are released immediately.

    Args:
        path: the photograph.
        settings: appearance of the targets.
        family: codes of the targets, None without codes.
        store: is searched first, and stores new measurements.
        name: name of the photograph, by which its mask is found.
        masks: what is black in that of the photograph has no targets.

    Raises:
        PhotographError: the photograph or its mask cannot be read.
        SurveyFileError: the mask has another size than the photograph.
    """
    stated, mask = target_settings(settings, family), masks.path_of(name)
    if mask is not None:
        stated += "\0" + content_hash(mask)

    def measured() -> Targets:
        pixels = read_photograph(path, channel=settings.channel)
        return targets_in(pixels, settings, family, hidden=masks.black(name, pixels.shape[1::-1]))

    return measured_once(store, path, TARGETS, stated, measured)


def target_settings(settings: TargetSettings, family: TargetFamily | None) -> str:
    """Return everything but the photograph that its targets depend on, as a text for the store's key."""
    codes = "none"
    if isinstance(family, TagFamily | ConcentricFamily):
        codes = family.name
    elif isinstance(family, PlateFamily | PlateGroup):
        codes = repr(family)
    elif family is not None:
        table = family.number.tobytes() + family.pattern.tobytes()
        codes = f"{family.cells} {family.inner} {family.outer} {hashlib.sha256(table).hexdigest()}"
    return settings.model_dump_json(include={"channel", "tone", "polarity", "min_diameter_px"}) + "\0" + codes


def targets_in(
    photograph: AnyArray,
    settings: TargetSettings,
    family: TargetFamily | None,
    *,
    hidden: BoolArray | None = None,
) -> Targets:
    """Return the targets of a photograph, (H, W), that was read in the channel of the settings.

    hidden: masked pixels, which have no targets, (H, W).
    """
    return find_targets(
        linearise_srgb(photograph) if settings.tone == "srgb" else photograph,
        polarity=settings.polarity,
        codes=family if family is not None else "none",
        min_diameter_px=settings.min_diameter_px,
        hidden=hidden,
    )


def image_point_covariance(targets: Targets, sigma_px: float) -> FloatArray:
    """Return the covariance of image points for the adjustment, px^2, (k, 2, 2).

    The fit of a target only contains the noise of the photograph. The survey's sigma of an image coordinate
    adds the other errors: JPEG, print, lens, or a sheet that is not flat.
    """
    return np.asarray(targets.covariance + sigma_px**2 * np.eye(2))


def each_photograph(
    photographs: PhotographList,
    work: Callable[[Path], T],
    *,
    places: Callable[[T], FloatArray] | None = None,
    jobs: int = 1,
    progress: Progress = SILENT,
) -> tuple[dict[int, T], tuple[FailedImage, ...]]:
    """Apply a function to every photograph, and return the results of those that could be read.

    A photograph that cannot be read does not stop the others. It is listed with the reason, and so is a copy
    of another photograph.

    Args:
        photographs: files of the photographs.
        work: function of a file; raises PhotographError with the reason if the file cannot be read.
        places: returns the image points of the result, px, (k, 2), by which a copy that was saved again, with
            other bytes, is recognised unless they are few.
        jobs: number of photographs processed in parallel.
        progress: receives every photograph.

    Returns:
        The results by the index of the photograph, and the failed photographs in their order.

    Raises:
        GeometryError: fewer than two readable photographs.
    """
    results: dict[int, T] = {}
    failed: dict[int, FailedImage] = {}
    originals = []
    for k, (name, first) in enumerate(zip(photographs.names, find_same_files(photographs), strict=True)):
        if first == k:
            originals.append(k)
        else:
            original = photographs.names[first]
            failed[k] = FailedImage(name, remark("copies", original=original, same="files"))
            progress.advance(name)

    def work_on(k: int) -> T:
        with working_on(f"photograph {photographs.names[k]}"):
            return work(photographs.paths[k])

    with ThreadPoolExecutor(max_workers=max(1, jobs)) as pool:
        running = {pool.submit(work_on, k): k for k in originals}
        try:
            for done in as_completed(running):
                k = running[done]
                try:
                    results[k] = done.result()
                except PhotographError as error:
                    reason = why_failed(error, photographs.paths[k])
                    failed[k] = FailedImage(
                        photographs.names[k], remark("photographs_unreadable", reason=reason)
                    )
                progress.advance(photographs.names[k])
        except BaseException:  # including Ctrl-C: do not wait for photographs not yet started
            pool.shutdown(wait=False, cancel_futures=True)
            raise
    pictures: dict[bytes, int] = {}
    for k in sorted(results):
        xy = np.zeros((0, 2)) if places is None else places(results[k])
        first = pictures.setdefault(xy.tobytes(), k) if len(xy) >= MIN_COMMON else k
        if first != k:
            original = photographs.names[first]
            failed[k] = FailedImage(
                photographs.names[k], remark("copies", original=original, same="pictures")
            )
            del results[k]
    in_order = tuple(failed[k] for k in sorted(failed))
    if len(results) < MIN_PHOTOGRAPHS:
        raise GeometryError(
            f"{counted(len(results), 'readable photograph')}, "
            f"at least {MIN_PHOTOGRAPHS} are needed{in_brackets(in_order)}"
        )
    return results, in_order


def find_same_files(photographs: PhotographList) -> tuple[int, ...]:
    """Return for every photograph the first one whose file has the same bytes; itself if it is not a copy.

    A copy is not a second observation: it would only make the result look more precise than it is.
    """
    first = list(range(len(photographs)))
    seen: dict[tuple[int, str], int] = {}
    sizes = [path.stat().st_size if path.is_file() else 0 for path in photographs.paths]
    number = Counter(sizes)
    for k, path in enumerate(photographs.paths):
        if sizes[k] and number[sizes[k]] > 1:
            with suppress(PhotographError):  # an unreadable file is reported when it is measured
                first[k] = seen.setdefault((sizes[k], content_hash(path)), k)
    return tuple(first)


def find_changed_files(photographs: PhotographList, hashes: Mapping[str, str]) -> tuple[Remark, ...]:
    """Return a remark on the photographs that are no longer the files in which points were marked.

    Args:
        photographs: all photographs.
        hashes: SHA-256 of the files of photographs, when they were marked, by name.
    """
    changed = list[str]()
    for name, path in zip(photographs.names, photographs.paths, strict=True):
        if hashes.get(name):
            with suppress(PhotographError):  # an unreadable file is reported when it is measured
                changed += [name] if content_hash(path) != hashes[name] else []
    return (remark("photographs_changed", photographs=changed),) if changed else ()


def why_failed(error: PhotographError, path: Path) -> str:
    """Return why a photograph cannot be read, without the photograph's name."""
    return str(error).removeprefix(f"{path.name}: ")


def in_brackets(failed: Sequence[FailedImage]) -> str:
    """Return the first photographs that could not be read and why, in brackets for the end of a message."""
    if not failed:
        return ""
    named = (f"{photograph.image}: {photograph.reason.text.rstrip('.')}" for photograph in failed)
    return f" ({listed(named, most=MAX_LISTED, separator='; ')})"


@dataclass(frozen=True)
class OtherSizes:
    """A survey in which all photographs of a camera have the same size."""

    survey: Survey
    files: PhotographList
    left_out: tuple[FailedImage, ...]
    remarks: tuple[Remark, ...]  # one for each new camera


def separate_sizes(survey: Survey, files: PhotographList) -> OtherSizes:
    """Give photographs of another size than the others of their camera a separate camera.

    They are left out if they are few, or if their camera is held at values that do not apply to another part
    of the sensor.

    Args:
        survey: states the cameras.
        files: photographs of the survey; those that cannot be read stay with their camera.
    """
    cameras, owner = list(survey.cameras), files.camera.copy()
    left: dict[int, Remark] = {}
    remarks = []
    for number, camera in enumerate(survey.cameras):
        counted: dict[Size, list[int]] = {}
        for k in np.flatnonzero(files.camera == number).tolist():
            if (metadata := files.metadata_of(k)) is not None:
                counted.setdefault(metadata.size_px, []).append(k)
        main = _main_size(camera, counted)
        if main is None:
            continue
        for size, rows in sorted(counted.items()):
            if size == main:
                continue
            what = _kind(size, main)
            # given values apply to the whole format only
            held = bool(camera.fixed or camera.weighted or (camera.states_free and not camera.may_be_free))
            held &= what != RESAMPLED
            if len(rows) < MIN_OWN or held:
                reason = remark(
                    "photograph_of_other_size",
                    camera=camera.name,
                    size=f"{size[0]} x {size[1]} px",
                    usual=f"{main[0]} x {main[1]} px",
                    what=what,
                    needed=None if held else MIN_OWN,
                )
                left |= dict.fromkeys(rows, reason)
                continue
            names = [files.names[k] for k in rows]
            cameras.append(_resized(camera, size, main, what, names))
            owner[rows] = len(cameras) - 1
            remarks.append(
                remark(
                    "camera_by_size",
                    photographs=names,
                    camera=camera.name,
                    new=cameras[-1].name,
                    size=f"{size[0]} x {size[1]} px",
                    usual=f"{main[0]} x {main[1]} px",
                    what=what,
                )
            )
    if not left and not remarks:
        return OtherSizes(survey, files, (), ())
    kept = [k for k in range(len(files)) if k not in left]
    return OtherSizes(
        replace(survey, cameras=tuple(cameras)),
        PhotographList(
            tuple(files.names[k] for k in kept),
            tuple(files.paths[k] for k in kept),
            owner[kept],
            files.folder,
        ),
        tuple(FailedImage(files.names[k], why) for k, why in sorted(left.items())),
        tuple(remarks),
    )


def _main_size(camera: CameraSettings, counted: dict[Size, list[int]]) -> Size | None:
    """Return the size of a camera: the stated size if any photograph has it, else the most frequent size.

    None if no photograph has the stated size, or none could be read.
    """
    if camera.size_px in counted:
        return camera.size_px
    if camera.size_px is not None or not counted:
        return None
    return max(counted, key=lambda size: (len(counted[size]), -counted[size][0]))


def _kind(size: Size, main: Size) -> str:
    if size == main[::-1]:
        return UPRIGHT
    ratio = (size[0] / size[1]) / (main[0] / main[1])
    return RESAMPLED if abs(ratio - 1) < MAX_ASPECT_DIFFERENCE else CROPPED


def _resized(
    camera: CameraSettings, size: Size, main: Size, what: str, names: Sequence[str]
) -> CameraSettings:
    """Return the settings of a camera for photographs of another size of the same sensor."""
    pixel = camera.pixel_mm
    if camera.sensor_mm is not None:
        pixel = camera.sensor_mm[0] / main[0], camera.sensor_mm[1] / main[1]
    if pixel is not None and what == RESAMPLED:
        pixel = pixel[0] * main[0] / size[0], pixel[1] * main[1] / size[1]
    if pixel is not None and what == UPRIGHT:
        pixel = pixel[::-1]
    return camera.model_copy(
        update={
            "name": f"{camera.name} {size[0]}x{size[1]}",
            "images": tuple(escape(name) for name in names),
            "size_px": None,
            "sensor_mm": None,
            "pixel_mm": pixel,
        }
    )
