"""The work of `kolinear undistort`: cameras, the photographs of each, what is drawn and written."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path, PurePosixPath

import numpy as np

from adapters.formats.cameras.lens_terms import Mounted, alone
from adapters.formats.cameras.opencv import pair_lines
from adapters.formats.cameras.registry import camera_format, read_cameras, write_cameras
from sfm.files.globs import why_no_folder
from sfm.files.open_folders import disk_errors, is_home_file, locked, refuse_foreign_folder
from sfm.files.whole_files import remove_leftovers, whole_folder
from sfm.model.camera_file import CameraFile
from sfm.model.display import counted, listed
from sfm.model.errors import PhotographError, SurveyFileError
from sfm.photographs.exif import conversion_of
from sfm.photographs.reading import SUFFIXES
from sfm.products.drafting.camera_names import cameras_in_names
from sfm.products.undistorting.photographs import UndistortedPhotographs
from sfm.products.undistorting.views import (
    RectifiedPair,
    View,
    pairs_of,
    rectified_pair,
    row_differences,
    undistorted_view,
)
from sfm.runtime.progress import Progress

SHOWN = 3  # names that a message lists
PAIRS_FORMAT = "opencv-camera"  # which has R1, R2, P1, P2 and Q
Moment = tuple[str, ...]


def undistort_photographs(
    cameras: Path,
    photographs: Path,
    out: Path,
    *,
    read_as: str | None,
    camera: str | None,
    pairs: bool,
    alpha: float | None,
    to: str,
    progress: Progress,
) -> tuple[str, ...]:
    """Draw the photographs of a folder without distortion, and write their new cameras beside them.

    Args:
        cameras: file of cameras, or a result.
        photographs: a folder, or one photograph.
        out: new folder, or an earlier one.
        read_as: name of the format of the cameras; None detects it.
        camera: name of the camera that took all photographs; None finds it for each.
        pairs: whether the photographs of a rig are rectified in pairs.
        alpha: see `sfm.products.undistorting.views.undistorted_view`.
        to: format of the files of the new cameras.
        progress: receives the photographs.

    Returns:
        What was drawn and written, in lines.

    Raises:
        KolinearError: cameras or photographs cannot be read, or do not belong together; nothing is written.
    """
    form = camera_format(to)
    if pairs and (camera is not None or to != PAIRS_FORMAT):
        raise SurveyFileError(
            f"{cameras}: --pairs takes both cameras of a rig and writes {PAIRS_FORMAT}; leave out --camera "
            "and --to"
        )
    refuse_foreign_folder(out)
    file = read_cameras(cameras, read_as)
    if camera is not None:
        file = file.only(camera)
    folder, names = photographs_of(photographs, out)
    owner = owners(file, names)
    lines: list[str] = []
    draw = UndistortedPhotographs()
    with locked(out.parent / f".{out.name}.lock", out):
        remove_leftovers(out)
        with whole_folder(out, "the photographs", replaceable=True) as target:
            if pairs:
                lines += _draw_pairs(file, names, owner, folder, target, draw, alpha, progress)
            else:
                views = [undistorted_view(camera, alpha) for camera in file.cameras]
                used = sorted(set(owner))
                progress.stage("undistorting", len(names))
                for name, k in sorted(zip(names, owner, strict=True), key=lambda pair: pair[1]):
                    _draw(draw, folder / name, views[k], target / name)
                    progress.advance()
                for k in used:
                    new = views[k].camera
                    path = target / f"camera-{_file_name(new.name)}{form.suffixes[0]}"
                    write_cameras(path, to, CameraFile(file.name, (new,), (None,)))
                    lines.append(
                        f"camera {new.name}: {counted(owner.count(k), 'photograph')} as "
                        f"{names[owner.index(k)]}, new camera "
                        f"{path.name}, f = {new.value('fx'):.4f} px"
                    )
    if draw.without_exif:
        lines.append(
            f"{counted(len(draw.without_exif), 'photograph')} of 16 bit: EXIF data not kept "
            f"({listed(draw.without_exif, most=SHOWN)})"
        )
    return (*lines, f"{out}: {counted(draw.count, 'photograph')} without distortion")


def photographs_of(path: Path, out: Path) -> tuple[Path, list[str]]:
    """Return the folder of photographs and their names in it, sorted; those in the output are left out.

    Args:
        path: a folder, or one photograph.
        out: folder of the output.

    Raises:
        PhotographError: there is no such folder, or no photograph in it.
        SurveyFileError: a photograph is a link that leaves the folder.
    """
    if path.is_file():
        return path.parent, [path.name]
    if not path.is_dir():
        raise PhotographError(f"{path}: {why_no_folder(path)}")
    inside = out.resolve()
    files = sorted(
        file
        for file in path.rglob("*")
        if (file.suffix.lower() in SUFFIXES or conversion_of(file))
        and file.is_file()
        and not file.resolve().is_relative_to(inside)
    )
    for file in files:
        if file.is_symlink() and not file.resolve().is_relative_to(path.resolve()) and not is_home_file(file):
            raise SurveyFileError(f"{file}: a link that leaves its folder; the file itself is needed there")
    if not files:
        raise PhotographError(f"{path}: no photographs are in this folder ({', '.join(SUFFIXES)})")
    return path, [file.relative_to(path).as_posix() for file in files]


def owners(file: CameraFile, names: Sequence[str]) -> list[int]:
    """Return the index of the camera of each photograph.

    The result that calibrated the cameras knows its photographs. Others are named like their camera, or, if
    the names propose as many cameras as there are, these are in the order of their names.

    Args:
        file: the cameras.
        names: names of the photographs with their folders.

    Raises:
        SurveyFileError: the camera of a photograph is not known.
    """
    taken_by: dict[str, str] = {}  # by the result, whose cameras may be more than those of the file
    if file.solution is not None:
        network, of_result = file.solution.network, file.solution.estimate.cameras
        taken_by = {
            _stem(name): of_result[k].name
            for name, k in zip(network.images, network.camera.tolist(), strict=True)
        }
    if len(file.cameras) == 1:
        only = file.cameras[0].name
        for name in names:
            if taken_by.get(_stem(name), only) != only:
                raise SurveyFileError(
                    f"{name}: camera {taken_by[_stem(name)]} took it by the result, not {only}; leave out "
                    "--camera, or give the photographs of one camera"
                )
        return [0] * len(names)
    known = {stem: file.index(name) for stem, name in taken_by.items()}
    proposed = cameras_in_names(list(names))
    order: dict[str, int] = {}
    if proposed is not None:
        parts = sorted(set(proposed.camera.values()))
        if len(parts) == len(file.cameras):
            order = {part: k for k, part in enumerate(parts)}
    whole = []  # what finds the name of each camera where no further letter or digit of its kind continues it
    for camera in file.cameras:
        ends = [r"\d" if end.isdigit() else r"[^\W\d_]" for end in (camera.name[0], camera.name[-1])]
        whole.append(re.compile(f"(?<!{ends[0]}){re.escape(camera.name)}(?!{ends[1]})"))
    of: list[int] = []
    for name in names:
        stem = _stem(name)
        named = [k for k, pattern in enumerate(whole) if pattern.search(stem)]
        if stem in known:
            of.append(known[stem])
        elif len(named) == 1:
            of.append(named[0])
        elif proposed is not None and proposed.camera.get(name) in order:
            of.append(order[proposed.camera[name]])
        else:
            cameras = listed([camera.name for camera in file.cameras], most=SHOWN)
            raise SurveyFileError(
                f"{name}: which of the cameras {cameras} took it is not known; name it with --camera, or put "
                "the name of the camera into that of the photograph"
            )
    return of


def _moments(file: CameraFile, names: Sequence[str]) -> dict[str, Moment]:
    """Return the moment of each photograph, by the result that calibrated the cameras or by the names."""
    proposed = cameras_in_names(list(names))
    by_name = {} if proposed is None else proposed.moment
    moments: dict[str, Moment] = {name: ("names", moment) for name, moment in by_name.items()}
    if file.solution is not None and file.solution.network.moment is not None:
        network = file.solution.network
        of_result = {
            _stem(name): str(t) for name, t in zip(network.images, file.solution.network.moment, strict=True)
        }
        known = {name: of_result[_stem(name)] for name in names if _stem(name) in of_result}
        moments |= {name: ("result", moment) for name, moment in known.items()}
    return moments


def _stem(name: str) -> str:
    """Return the name of a photograph without its ending, which may have been converted."""
    return PurePosixPath(name).with_suffix("").as_posix()


def _draw_pairs(
    file: CameraFile,
    names: Sequence[str],
    owner: Sequence[int],
    folder: Path,
    target: Path,
    draw: UndistortedPhotographs,
    alpha: float | None,
    progress: Progress,
) -> list[str]:
    """Draw rectified pairs, and write their cameras; return what was drawn in words."""
    if file.mounts is None or not any(file.mounts.rig):
        raise SurveyFileError(
            f"{file.name}: how the cameras are mounted is not known, which pairs require: needed a result "
            "with [[rig]], or a file with R and T"
        )
    moments = _moments(file, names)
    pairs = [rectified_pair(file.cameras, file.mounts, a, b, alpha or 0.0) for a, b in pairs_of(file.mounts)]
    places = list(pairs_of(file.mounts))
    shots: list[tuple[RectifiedPair, str, View]] = []
    lines = []
    for (a, b), pair in zip(places, pairs, strict=True):
        of = [
            {moments[n]: n for n, k in zip(names, owner, strict=True) if k == c and n in moments}
            for c in (a, b)
        ]
        common = [moment for moment in of[0] if moment in of[1]]
        title = f"{pair.first.former.name}-{pair.second.former.name}"
        if not common:
            raise SurveyFileError(
                f"{title}: no photographs of one moment of both cameras are in the folder; names such as "
                "left01.jpg and right01.jpg, or those of the result, are needed"
            )
        for view, by_moment in zip((pair.first, pair.second), of, strict=True):
            shots += [(pair, by_moment[moment], view) for moment in common]
        inside = target if len(pairs) == 1 else target / _file_name(title)
        inside.mkdir(exist_ok=True)
        path = inside / f"rectified-{_file_name(title)}.yaml"
        second = Mounted(pair.second.camera, np.eye(3), pair.base)
        yaml = pair_lines(alone(pair.first.camera), second, file.unit, rectified=pair.rectification)
        path.write_text("\n".join(yaml) + "\n", encoding="utf-8", newline="")
        words = (
            f"{title}: {counted(len(common), 'pair')} as {of[0][common[0]]} and {of[1][common[0]]}, new "
            f"cameras, R1, R2, P1, P2 and Q in {path.name}"
        )
        if file.solution is not None and len(v := row_differences(pair, file.solution)):
            what = "columns" if pair.axis else "rows"
            words += (
                f"; {what} of conjugate image points differ by {float(np.mean(v)):+.4f} px on average, "
                f"{float(np.sqrt(np.mean(v**2))):.4f} px RMS"
            )
        lines.append(words)
    progress.stage("rectifying", len(shots))
    for pair, name, view in shots:
        title = _file_name(f"{pair.first.former.name}-{pair.second.former.name}")
        inside = target if len(pairs) == 1 else target / title
        _draw(draw, folder / name, view, inside / name)
        progress.advance()
    left = len(names) - len({name for _, name, _ in shots})
    return [*lines, *([f"{counted(left, 'photograph')} without a partner left out"] if left else [])]


def _draw(draw: UndistortedPhotographs, path: Path, view: View, out: Path) -> None:
    with disk_errors(f"{out.name}: the photograph cannot be written"):
        out.parent.mkdir(parents=True, exist_ok=True)
    draw.draw(path, view, out)


def _file_name(name: str) -> str:
    return "".join(c if c.isalnum() or c in "_.-" else "_" for c in name)
