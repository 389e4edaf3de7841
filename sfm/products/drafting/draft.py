"""Draft of a survey file from a folder of photographs; comments state the source of every value.

The cameras come from EXIF data, and the targets from a trial on a few photographs.
"""

from __future__ import annotations

import json
import os
import re
import shlex
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from textwrap import fill
from typing import NoReturn

import numpy as np

from sfm.files.globs import find_files, why_no_folder
from sfm.files.open_folders import is_home_file
from sfm.files.plain_text import as_plain, is_name, is_plain
from sfm.model.display import agreeing, counted
from sfm.model.errors import GeometryError, PhotographError, SurveyFileError
from sfm.model.remarks.remark import Remark, remark, unless_note
from sfm.photographs.camera_files import is_camera_file
from sfm.photographs.exif import UNREAD, USUAL_SIGMAS_M, Metadata, conversion_of, read_metadata
from sfm.photographs.masks import MASKS, Masks, find_masks
from sfm.photographs.reading import PLAIN, SUFFIXES
from sfm.photographs.video_files import PREVIEW, VIDEO
from sfm.products.drafting.camera_groups import (
    BY_TIMES,
    CameraGroup,
    Grouping,
    ProposedRig,
    SensorWidth,
    group_photographs,
)
from sfm.products.drafting.camera_names import IN_ORDER
from sfm.products.drafting.camera_times import USUAL_S
from sfm.products.drafting.lens_models import with_lens_models
from sfm.products.drafting.ringed_dots import picture_of_rings
from sfm.products.drafting.target_trial import MIN_TARGETS, TargetTrial, try_targets
from sfm.runtime.progress import SILENT, Progress
from sfm.survey.inputs.sources import TARGETS
from sfm.survey.measuring.measured_store import MeasuredStore
from sfm.survey.orientation import FISHEYE
from sfm.targets.codes.plates import BOARDS, FAMILIES, GRIDS, PLATES, PlateFamily

DEPTHS = ("*", "*/*")  # where photographs are searched; the first that has some is used
COMMENT_WIDTH = 100  # characters
MOMENT_IN_NAMES = "in brackets: what photographs of one moment have in common"
MOMENTS = {
    IN_ORDER: "the first photographs of all cameras are of one moment, and so on",
    BY_TIMES: "by the times in EXIF data, whatever the clocks differ by",
}
FREE_OF_TEXTURE = ("c", "x0", "y0", "K1", "K2")
FREE_BY_TARGETS = ("c", "x0", "y0", "K1", "K2", "K3", "P1", "P2", "b1", "b2")
FREE_OF_FISHEYES = ("fx", "fy", "cx", "cy", "k1", "k2", "k3", "k4")
SIGMA_PX, CORNER_SIGMA_PX = 0.05, 0.1  # of circles; and of corners, crossings and natural points
OUTSIDE = "not used outside the folder: move the masks, or uncomment the line for --allow-outside"
PITCH = 25.0  # assumed pitch of a plate, UNIT: that of many printed boards
UNIT = "mm"
IMAGES = "images"  # folder of the photographs in a project of COLMAP and the programs that follow it
FURTHER = "its further pictures, as only the first of a file is read; save each as a file of its own"
MAX_SHOWN = 8  # names listed on a line


@dataclass(frozen=True)
class Draft:
    """A drafted survey."""

    name: str
    text: str  # text of the survey file
    found: tuple[tuple[str, str], ...]  # (subject, finding), for the terminal
    remarks: tuple[Remark, ...]  # points for a person to check
    left_out: tuple[tuple[str, str], ...]  # (photograph, reason)
    rings: bytes = (
        b""  # PNG picture of dots with rings that no family of codes reads, empty without such dots
    )


def draft_survey(
    folder: Path,
    *,
    sensor_width: SensorWidth = lambda make, model: None,
    pitch: float | None = None,
    name: str | None = None,
    stated: str | None = None,
    store: MeasuredStore | None = None,
    progress: Progress = SILENT,
) -> Draft:
    """Draft a survey file for the photographs in a folder.

    Args:
        folder: contains the photographs. Its subfolders are searched if it contains none itself, and are used
            if they contain the photographs of the cameras of a rig.
        sensor_width: looks up the sensor width if EXIF data do not give the pixel size.
        pitch: distance of neighbouring dots or crossings if there is a plate, mm; assumed if not given.
        name: name of the survey; the first of `names_of_folder` if not given.
        stated: the folder as the survey file states it; None for a survey file in the folder.
        store: stores the targets that the trial measures.
        progress: receives the steps of the trial.

    Raises:
        SurveyFileError: the folder does not exist or has no photographs.
        GeometryError: fewer than two readable photographs.
    """
    metadata, unreadable = metadata_of_folder(folder, stated)
    masks, masked = find_masks(folder, tuple(metadata))
    unused = "" if masked == MASKS else OUTSIDE
    try:
        masks.refuse_wrong({name: folder / name for name in metadata})
    except SurveyFileError as error:  # a folder of this name may have another purpose
        masks, unused = Masks(), f"not used: {error}"
    # a link may be of use where the survey is run, which checks it
    others = [other for other, _ in unreadable if not (folder / other).is_symlink()]
    grouping = group_photographs(metadata, sensor_width, others=others)
    if grouping.rig is None and any("/" in name for name in metadata):
        _refuse_folder(folder)
    used = [name for camera in grouping.cameras for name in camera.photographs]
    if len(used) < 2:
        raise GeometryError(
            f"{folder}: {counted(len(used), 'photograph')} of one camera, at least 2 are needed"
            + "".join(f"; {name}: {why}" for name, why in (*unreadable, *grouping.left_out)[:MAX_SHOWN])
        )
    paths = [folder / name for name in used]
    trial = try_targets(paths, folder=folder, masks=masks, store=store, progress=progress)
    name = name or next(names_of_folder(folder))
    positions = sum(metadata[photograph].position is not None for photograph in used)
    further = ((name, FURTHER) for name in used if metadata[name].several)
    left_out = (*unreadable, *grouping.left_out, *trial.unreadable, *further)
    content = _Content(name, stated, grouping, trial, pitch, left_out, positions, masked, unused)
    if trial.plate is not None:
        silent = _text(content, models=False)
        cameras = with_lens_models(silent, grouping.cameras, folder, store=store, progress=progress)
        content = replace(content, grouping=replace(grouping, cameras=cameras))
    return Draft(
        name, _text(content), _findings(content), _remarks(content), left_out, picture_of_rings(trial.ringed)
    )


@dataclass(frozen=True)
class _Content:
    """What a folder contains, as a draft states it."""

    name: str  # of the survey
    stated: str | None  # folder of the photographs, relative to the survey file; None if it is there
    grouping: Grouping
    trial: TargetTrial
    pitch: float | None  # of a plate, mm; None if it is assumed
    left_out: tuple[tuple[str, str], ...]  # (photograph, reason)
    positions: int  # number of photographs with a position in their EXIF data
    masked: str  # where the masks are, relative to the folder; "" without any
    unused: str  # why the masks are not used, "" if they are

    @property
    def free(self) -> tuple[str, ...]:
        """Free parameters of the cameras; empty for texture and plates, where the adjustment chooses them."""
        return FREE_BY_TARGETS if self.trial.codes != "none" and self.trial.plate is None else ()


def names_of_folder(folder: Path) -> Iterator[str]:
    """Yield names for the survey of a folder of photographs, the usual one first.

    Folders named `images` are in the folder of their project, which has the name of the object. A further
    name takes the folder above too, where surveys of several folders would have the same.

    Args:
        folder: contains the photographs.
    """
    parts = [as_plain(part) for part in folder.resolve().parts[1:]] or ["survey"]
    if parts[-1].casefold() == IMAGES and len(parts) > 1:
        yield parts[-2]
    else:
        yield parts[-1]
    for k in range(2, len(parts) + 1):
        yield " ".join(parts[-k:])


def metadata_of_folder(
    folder: Path, stated: str | None = None
) -> tuple[dict[str, Metadata], tuple[tuple[str, str], ...]]:
    """Return size and EXIF data of the photographs of a folder, and the unreadable ones with the reason.

    Args:
        folder: contains the photographs.
        stated: the folder as the survey file states it. Below the folder of that file, links may lead to all
            files that are there too, as when it is run.
    """
    if not folder.is_dir():
        raise SurveyFileError(f"{folder}: {conversion_of(folder) or why_no_folder(folder)}")
    levels = () if stated is None or Path(stated).is_absolute() else Path(stated).parts
    home = folder.resolve()
    if levels and os.pardir not in levels:
        home = Path(os.path.abspath(folder)).parents[len(levels) - 1].resolve()
    files = _files_of(folder)
    files = [path for path in files if not path.is_relative_to(folder / MASKS)] or files
    if all(conversion_of(path) for path in files):
        _refuse_folder(folder, files)
    metadata, unreadable = {}, []
    developed = {path.with_suffix(""): path for path in files if path.suffix.lower() in PLAIN}
    for path in files:
        name = path.relative_to(folder).as_posix()
        if not is_plain(name):
            unreadable.append((as_plain(name), "its name has control or invisible characters"))
            continue
        if not (path.resolve().is_relative_to(home) or is_home_file(path)):
            unreadable.append((name, "a link out of the folder, and not to a file in your home folder"))
            continue
        other = developed.get(path.with_suffix(""))
        if other not in (None, path) and is_camera_file(path):
            unreadable.append((name, f"of the same exposure as {other.name}"))
            continue
        try:
            metadata[name] = read_metadata(path)
        except PhotographError as error:
            unreadable.append((name, str(error).removeprefix(f"{path.name}: ")))
    return metadata, (*unreadable, *_videos_beside(folder, files))


def _videos_beside(folder: Path, files: Sequence[Path]) -> tuple[tuple[str, str], ...]:
    """Return the videos beside photographs with the reason why they are left out.

    Telephones write a short video beside each photograph, of its name: it is of no further use.
    """
    alive = {path.stem.casefold() for path in files}
    videos = [path for path in find_files(folder, "*", hidden=False) if path.suffix.lower() in VIDEO]
    return tuple(
        (
            as_plain(path.name),
            f"a video beside photographs; run it alone: kolinear run {as_plain(shlex.quote(str(path)))}",
        )
        for path in videos
        if path.stem.casefold() not in alive and path.suffix.lower() != PREVIEW
    )


def has_photographs(folder: Path) -> bool:
    """Return whether a survey file can be drafted for a folder, as far as names show.

    Args:
        folder: the folder.
    """
    return bool(_files_of(folder))


def _files_of(folder: Path) -> list[Path]:
    """Return the files of a folder that are photographs by their names, else those of its subfolders."""
    files: list[Path] = []
    for depth in DEPTHS:
        files = files or [
            path
            for path in find_files(folder, depth, hidden=depth == DEPTHS[0])
            if path.suffix.lower() in SUFFIXES or path.suffix.lower() in UNREAD
        ]
    return files


def _refuse_folder(folder: Path, raw: Sequence[Path] = ()) -> NoReturn:
    """Refuse a folder without photographs of its own, whose subfolders are not those of a rig."""
    every = sorted(folder.iterdir())
    content = (
        f"it contains {', '.join(as_plain(path.name) for path in every[:MAX_SHOWN])}"
        if every
        else "it is empty"
    )
    unread = (conversion_of(path) for path in (*raw, *every))
    content += next((f": {words}" for words in unread if words), "")
    content += "".join(
        f"; try {as_plain(str(path))}" for path in every if path.name != MASKS and _has_photographs(path)
    )
    raise SurveyFileError(f"{folder}: no photographs ({', '.join(PLAIN)}, HEIF or raw), {content}")


def _has_photographs(folder: Path) -> bool:
    """Return whether a folder itself contains photographs."""
    try:
        return folder.is_dir() and any(path.suffix.lower() in SUFFIXES for path in folder.iterdir())
    except OSError:
        return False


def _text(content: _Content, *, models: bool = True) -> str:
    """Return the text of the survey file, with or without the models of the cameras."""
    grouping, trial, pitch = content.grouping, content.trial, content.pitch
    lines = [
        "# Drafted from the photographs; every value may be changed, and what is measured already is kept.",
        "[survey]",
        f"name = {_quoted(content.name)}",
        f"unit = {_quoted(UNIT)}  # of the object coordinates; write the one of your scale bars",
    ]
    if content.stated is not None:
        if is_name(content.stated):
            lines.append(
                f"photographs = {_quoted(content.stated)}  # their folder, from the folder of this file"
            )
        else:  # no key can state it
            lines.append(f"# the photographs are in {as_plain(content.stated)}, which only --images can name")
    if content.masked:
        commented = "# " if content.unused else ""
        lines.append(f"{commented}masks = {_quoted(content.masked)}  # what is black there is ignored")
    for camera in grouping.cameras:
        lines += ["", *_camera_lines(camera, content.free, models=models)]
    if grouping.rig is not None:
        lines += ["", *_rig_lines(grouping.rig)]
    if content.left_out:
        lines += ["", "# Left out:"]
        lines += [f"#   {name}: {as_plain(why)}" for name, why in content.left_out]
    lines += ["", *_target_lines(trial, pitch)]
    if trial.plate is None:
        lines += ["", "[datum]", 'kind = "free"  # shape first; "control" with known points']
        lines += ["", *_example_lines(trial)]
        if content.positions:
            east, _, up = USUAL_SIGMAS_M
            state = agreeing(content.positions, "states|state")
            lines += [
                "#",
                f"# {counted(content.positions, 'photograph')} {state} a position (EXIF), no better than the "
                "receiver.",
                '# For scale and datum from positions, "control" and:',
                "# [exterior]",
                f"# exif_sigma_m = [{east:g}, {up:g}]  # m, in the plane and of the height, where none is "
                "stated",
            ]
    else:
        lines += ["", "[datum]", 'kind = "control"  # the first plate, flat and true, is the datum']
        for plate in trial.plates[1:]:
            lines += ["", "# fixed to the first plate; its points are measured", "[[plate]]"]
            lines += _plate_keys(plate, pitch)
        lines += [f"# Left out: {_described(plate)} ({why})" for plate, why in trial.left_out]
    sigma = CORNER_SIGMA_PX if trial.codes in ("none", *BOARDS) else SIGMA_PX
    lines += [
        "",
        "[adjust]",
        f"sigma_px = {sigma:g}  # of an image coordinate before adjusting; the report states what fits",
        "",
        "[compare]",
        'backend = "colmap"  # adjust with COLMAP too and compare; "none" saves the time',
    ]
    return "\n".join(lines) + "\n"


def _camera_lines(camera: CameraGroup, free: Sequence[str], *, models: bool) -> list[str]:
    globs = camera.globs[0] if len(camera.globs) == 1 else list(camera.globs)
    lines = [
        f"# {counted(len(camera.photographs), 'photograph')} of {camera.size_px[0]} x {camera.size_px[1]} px",
        "[[camera]]",
        f"name = {_quoted(camera.name)}",
        f"images = {json.dumps(globs, ensure_ascii=False)}",
        f"pixel_mm = [{camera.pixel_mm[0]:.7g}, {camera.pixel_mm[1]:.7g}]  # {as_plain(camera.pixel_source)}",
        f"c_mm = {camera.c_mm:.6g}  # start value: {camera.c_source}",
    ]
    if camera.assumed:
        lines.append("c_assumed = true  # remove this once c_mm and pixel_mm are known")
    if models:
        lines += _model_lines(camera, free)
    return lines + [f"# {as_plain(said.text)}" for said in camera.remarks]


def _rig_lines(rig: ProposedRig) -> list[str]:
    lines = [
        f"# {_what_pairs(rig).capitalize()} pair up: {counted(rig.moments, 'moment')}, "
        f"as {as_plain(' and '.join(rig.example))}.",
        "# Check that the cameras are fixed to one another and triggered together; else remove this section.",
        "[[rig]]",
        'name = "rig"',
        f"cameras = {json.dumps(list(rig.cameras))}  # the first is the reference",
        f"moment = {_quoted(rig.moment)}  # {MOMENTS.get(rig.moment, MOMENT_IN_NAMES)}",
    ]
    if rig.tolerance_s != USUAL_S:
        lines.append(f"tolerance_s = {rig.tolerance_s:g}  # of times of one moment")
    return lines


def _what_pairs(rig: ProposedRig) -> str:
    return "times" if rig.moment == BY_TIMES else "names"


def _model_lines(camera: CameraGroup, free: Sequence[str]) -> list[str]:
    """Return the lines of model and free parameters; as comments where they are chosen."""
    lines = (
        ['model = "brown"'] if free else ['# model = "brown"  # without it: what the photographs determine']
    )
    if camera.fisheye:
        lines, free = (
            [f'model = "{FISHEYE}"  # {as_plain(camera.fisheye)}'],
            (),  # with k3 and k4 free, four photographs of a board left 200 px, with those determined 1.3 px
        )
    usual = list(FREE_OF_FISHEYES if camera.fisheye else FREE_OF_TEXTURE)
    without = "  # without it: what the photographs determine"
    return [*lines, f"free = {json.dumps(list(free))}" if free else f"# free = {json.dumps(usual)}{without}"]


def _target_lines(trial: TargetTrial, pitch: float | None) -> list[str]:
    names_of: dict[str, list[str]] = {}
    for name in FAMILIES:
        names_of.setdefault(re.split(r"[\d_]", name)[0], []).append(name)
    codes = ", ".join(names[0] if len(names) == 1 else f"{kind}…" for kind, names in names_of.items())
    text = f"# Codes: {codes}; plates: {', '.join(PLATES)}"
    kinds = fill(text, COMMENT_WIDTH, subsequent_indent="# ", break_on_hyphens=False).splitlines()
    if trial.plate is not None:
        assumed = "pitch_assumed = true  # the pitch sets the scale; remove this line once it is measured"
        return [*kinds, "[targets]", *_plate_keys(trial.plate, pitch)] + ([] if pitch else [assumed])
    common = ", ".join(f"{family} {count}" for family, count in trial.counts if count) or "none"
    tried = f"# Tried on {', '.join(trial.photographs)}; codes that two of them have in common: {common}"
    lines = [tried, *kinds]
    if trial.codes == "none":
        lines += ["# No coded targets: points of natural texture take their place.", "[tie_points]"]
        if trial.lattice and not trial.ringed:
            rows, columns = trial.lattice
            lines += [
                f"# Circles are in up to {rows} rows and {columns} columns. If they are a plate, correct "
                "these lines",
                "# and put them in place of [tie_points]:",
                "# [targets]",
                f"# codes = {_quoted(next(iter(GRIDS)))}  # or {', '.join(list(GRIDS)[1:])}",
                f"# rows = {rows}",
                f"# columns = {columns}",
                f"# pitch = {pitch or PITCH:g}  # {UNIT}, distance of neighbouring dots in a row",
            ]
        return lines
    lines += ["[targets]", f"codes = {_quoted(trial.codes)}", f"polarity = {_quoted(trial.polarity)}"]
    if trial.fewest < TARGETS.fewest:
        shows = counted(trial.fewest, "code")
        lines += [
            f"# A photograph that was tried shows {shows}, and {TARGETS.fewest} orient it: texture helps.",
            "[tie_points]",
        ]
    return lines


def _plate_keys(plate: PlateFamily, pitch: float | None) -> list[str]:
    lines = [
        f"codes = {_quoted(plate.name)}",
        f"rows = {plate.rows}  # of dots, of crossings inside the board, or of corners of tags",
        f"columns = {plate.columns}",
        f"pitch = {pitch or PITCH:g}  # {UNIT}, distance of neighbouring dots, crossings or tags",
    ]
    if plate.marks:
        lines.append(f"marks = {json.dumps([list(mark) for mark in plate.marks])}  # row and column, from 0")
    if plate.dictionary:
        lines += [
            f"dictionary = {_quoted(plate.dictionary)}",
            f"tag_size = {plate.tag_share * (pitch or PITCH):.4g}  # {UNIT}, side of the tags: "
            f"{plate.tag_share:g} of the pitch",
        ]
    if plate.first_tag:
        lines.append(f"first_tag = {plate.first_tag}  # number of the first tag of the board")
    return lines


def _described(plate: PlateFamily) -> str:
    marks = f", {counted(len(plate.marks), 'mark')}" if plate.marks else ""
    return f"{plate.name} of {plate.rows} rows and {plate.columns} columns{marks}"


def _example_lines(trial: TargetTrial) -> list[str]:
    first, second = trial.repeated[:2] if len(trial.repeated) > 1 else ("1", "2")
    ends, known, named = "targets", "coordinates", list[str]()
    if trial.codes == "none":  # points of natural texture have other numbers in every run
        first, second = "corner 1", "corner 2"
        ends, known = "points with names", "coordinates of such points"
        named = [
            "# Points of texture have other names in every run. A point that you name in one photograph",
            "# keeps its name and is found in the others (repeat the section for each point):",
            "# [[point]]",
            f"# name = {_quoted(first)}",
            f"# image = {_quoted(next(iter(trial.photographs), 'photograph.jpg'))}",
            "# x_px = 1200.5",
            "# y_px = 800.5",
            "#",
        ]
    return [
        *named,
        f"# The scale comes from a measured distance between two {ends} (repeat the section for more):",
        "# [[scale_bar]]",
        f"# from = {_quoted(first)}",
        f"# to = {_quoted(second)}",
        f"# length = 1000.0  # {UNIT}",
        f"# sigma = 0.05  # {UNIT}",
        "#",
        f"# Known {known}, a table id,X,Y,Z[,sX,sY,sZ] beside this file:",
        "# [control]",
        '# file = "control.csv"',
    ]


def _findings(content: _Content) -> tuple[tuple[str, str], ...]:
    """Return the findings for the terminal."""
    grouping, trial = content.grouping, content.trial
    findings = [
        (
            f"camera {camera.name}",
            f"{counted(len(camera.photographs), 'photograph')}, {camera.size_px[0]} x "
            f"{camera.size_px[1]} px, c "
            f"{camera.c_mm:.4g} mm ({camera.c_source}), pixel {1000 * camera.pixel_mm[0]:.4g} um "
            f"({camera.pixel_source})",
        )
        for camera in grouping.cameras
    ]
    findings += [
        (f"lens of {camera.name}", f"fisheye, {camera.fisheye}")
        for camera in grouping.cameras
        if camera.fisheye
    ]
    if grouping.rig is not None:
        findings.append(
            (
                "rig",
                f"{' and '.join(grouping.rig.cameras)}, {counted(grouping.rig.moments, 'moment')} by the "
                f"{_what_pairs(grouping.rig)}; check that the cameras are fixed to one another, else remove "
                "[[rig]]",
            )
        )
    if trial.plate is not None:
        findings.append(("targets", "; ".join(map(_described, trial.plates))))
        findings += [("left out", f"{_described(plate)} ({why})") for plate, why in trial.left_out]
    elif trial.codes != "none":
        repeated = (
            f"{counted(len(trial.repeated), 'code')} that two of {len(trial.photographs)} photographs have"
        )
        findings.append(("targets", f"{trial.codes}, {trial.polarity}; {repeated}"))
    else:
        findings.append(("targets", "none with codes: points of natural texture"))
    if content.masked:
        use = content.unused or "what is black in them is ignored"
        findings.append(("masks", f"in {content.masked}; {use}"))
    if content.positions:
        stating = counted(content.positions, "photograph")
        findings.append(("positions", f"in EXIF data of {stating}, not used as observations"))
    return tuple(findings)


def _remarks(content: _Content) -> tuple[Remark, ...]:
    """Return the remarks on photographs, cameras and targets."""
    grouping, trial = content.grouping, content.trial
    remarks = [said for camera in grouping.cameras for said in camera.remarks]
    assumed = [camera.name for camera in grouping.cameras if camera.assumed]
    if assumed:
        remarks.append(remark("camera_assumed", cameras=assumed))
    # cameras of one size, or of one body, may be one; those of a rig are two
    of_rig = () if grouping.rig is None else grouping.rig.cameras
    alone = [camera for camera in grouping.cameras if camera.name not in of_rig]
    of_size = Counter(camera.size_px for camera in alone)
    of_body = Counter(camera.body for camera in alone)
    alike = [
        f"{camera.name} ({len(camera.photographs)} of {camera.size_px[0]} x {camera.size_px[1]} px)"
        for camera in alone
        if max(of_size[camera.size_px], of_body[camera.body]) > 1
    ]
    if alike:
        remarks.append(remark("several_cameras", cameras=alike))
    if trial.plate is not None and content.pitch is None:
        remarks.append(remark("plate_pitch_assumed", pitch=(PITCH, UNIT)))
    if np.isfinite(trial.blur_px):
        remarks += unless_note(remark("targets_blurred", blur=(trial.blur_px, "px")))
    if trial.ringed:
        most = max(trial.ringed, key=lambda dots: len(dots.crops))
        remarks.append(
            remark("rings_not_read", photograph=most.photograph, dots=most.dots, ringed=len(most.crops))
        )
    elif trial.codes == "none" and (trial.lattice is not None or trial.circles >= MIN_TARGETS):
        rows, columns = trial.lattice or (None, None)
        circles = round(trial.circles)
        remarks.append(remark("circles_without_codes", circles=circles, rows=rows, columns=columns))
    return tuple(remarks)


def _quoted(text: str) -> str:
    """Return a TOML basic string; JSON strings are a subset of these."""
    return json.dumps(text, ensure_ascii=False)
