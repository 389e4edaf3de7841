"""The work of `kolinear convert` for cameras: read, adjusted in a model that the format has, written."""

from __future__ import annotations

import math
import re
from dataclasses import replace
from pathlib import Path

from adapters.formats.cameras.registry import (
    CameraFormat,
    camera_format,
    read_cameras,
    write_cameras,
)
from adapters.formats.content import Content
from adapters.formats.registry import format_named
from sfm.comparison.camera_readjustment import LIMIT_PX, Readjusted, readjust_cameras, residuals_px
from sfm.files.open_folders import refuse_links
from sfm.files.whole_files import refuse_existing, whole_folder
from sfm.model.camera_file import CameraFile
from sfm.model.conventions import METRES
from sfm.model.display import counted, listed
from sfm.model.errors import OutputError

KALIBR = "kalibr-camera"


def write_camera_files(
    source: Path,
    target: Path,
    to: str,
    *,
    read_as: str | None = None,
    camera: str | None = None,
    inexact: bool = False,
) -> str:
    """Write the cameras of a file or result in a format of cameras.

    Args:
        source: file of cameras, result or survey.
        target: new file; without an ending a new folder, if there are several cameras and the format has one
            of them, or a pair, in a file.
        to: name of the format.
        read_as: name of the format of the source; None detects it.
        camera: name of the only camera to write; None writes all.
        inexact: whether a misfit above the limit is accepted.

    Returns:
        What was written, a line for each camera that was converted and for each file.

    Raises:
        KolinearError: the source has no cameras, the format cannot hold them within the limit, or the target
            cannot be written.
    """
    form = camera_format(to)
    refuse_existing(target)
    file = read_cameras(source, read_as)
    if camera is not None:
        file = file.only(camera)
    elif len(file.cameras) > 1 and not form.several(file) and target.suffix:
        file = file.only(None)  # which names the cameras
    file = with_residuals(file)
    file, conversions = readjust_cameras(file, form.stored, form.forms)
    refuse_inexact(conversions, inexact=inexact)
    lines = [conversion.words for conversion in conversions]
    of_rigs = {} if file.mounts is None else file.mounts.by_rig()
    if max(map(len, of_rigs.values()), default=0) > 1:  # a rig is written whole
        if not form.mounted(file):
            lines.append(f"{form.name} does not store how these cameras are mounted, as {KALIBR} does")
        elif form.name == KALIBR and file.unit not in METRES:
            unit = file.unit or "unknown units"
            lines.append(f"translations are in {unit}, which {form.program} takes for metres")
    always = form.several(file.only(file.cameras[0].name))  # several cameras, also where they are no pair
    if len(file.cameras) == 1 or (form.several(file) and (target.suffix or always)):
        write_cameras(target, to, file)
        return "\n".join([*lines, f"{target}: {counted(len(file.cameras), 'camera')} as {to}"])
    refuse_links(target)
    names = _file_names(target, file, form)
    with whole_folder(target) as folder:
        for name, lens in zip(names, file.cameras, strict=True):
            write_cameras(folder / name, to, file.only(lens.name))
    return "\n".join([*lines, f"{target}: {counted(len(names), 'camera')} as {to}: {listed(names)}"])


def with_residuals(file: CameraFile) -> CameraFile:
    """Return cameras with the RMS of their residuals, where the result that calibrated them is known."""
    if file.solution is None or file.rms_px:
        return file
    names = [camera.name for camera in file.solution.estimate.cameras]
    rms = residuals_px(file.solution)
    known = tuple(rms[names.index(camera.name)] for camera in file.cameras)
    return replace(file, rms_px=() if any(map(math.isnan, known)) else known)


def readjusted_content(content: Content, to: str, *, inexact: bool) -> tuple[Content, tuple[Readjusted, ...]]:
    """Return a result whose cameras are adjusted again in models that a format of rigs stores.

    Args:
        content: the result.
        to: name of the format.
        inexact: whether a misfit above the limit is accepted.

    Raises:
        KolinearError: a misfit is above the limit.
    """
    from adapters.formats.cameras.registry import LensForm
    from sfm.model.camera_file import cameras_of

    forms = tuple(LensForm(model) for model in format_named(to).models)
    file, conversions = readjust_cameras(
        cameras_of(content.result),
        lambda camera: camera if camera.model in format_named(to).models else None,
        forms,
    )
    refuse_inexact(conversions, inexact=inexact)
    estimate = replace(content.result.estimate, cameras=file.cameras, mounts=file.mounts)
    return replace(content, result=replace(content.result, estimate=estimate)), conversions


def refuse_inexact(conversions: tuple[Readjusted, ...], *, inexact: bool) -> None:
    """Raise OutputError for the first conversion whose misfit is above the limit, unless it was asked for."""
    for conversion in conversions:
        if conversion.rms_px > LIMIT_PX and not inexact:
            ideal = not conversion.camera.parameters[conversion.camera.parts[2]].any()
            remedy = (
                "kolinear undistort makes photographs that it fits" if ideal else "another format may have it"
            )
            raise OutputError(
                f"camera {conversion.former.name}: model {conversion.model} differs from "
                f"{conversion.former.model} by {conversion.rms_px:.3f} px RMS, {conversion.max_px:.3f} px at "
                f"most, more than {LIMIT_PX:g} px; --inexact writes it all the same, {remedy}"
            )


def _file_names(target: Path, file: CameraFile, form: CameraFormat) -> list[str]:
    """Return the name of the file of each camera in a folder.

    Raises:
        OutputError: two are the same.
    """
    names = [re.sub(r"[^\w.\-]+", "_", camera.name) + form.suffixes[0] for camera in file.cameras]
    for name in names:
        if names.count(name) > 1:
            raise OutputError(
                f"{target}: two files would be {name}; rename cameras, or name one with --camera"
            )
    return names
