"""The page of `kolinear view`: any stored result for exploration, in one file."""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path

import numpy as np

from sfm.files.open_folders import disk_errors
from sfm.files.whole_files import refuse_existing, whole_file
from sfm.model.display import counted
from sfm.model.remarks.verdict import Line
from sfm.report.page import Banner, Column, FoldedParts, Page, Section, Table, axes, facts
from sfm.report.pages import html
from sfm.report.phrases import fixed
from sfm.report.viewer.embedded import viewer_of
from sfm.report.viewer.pictures import BUDGET_MB, Pictures, ViewerScene, cut_pictures
from sfm.runtime.progress import SILENT, Progress

MARK = b"<!DOCTYPE html>\n<!-- kolinear view -->\n"
"""identifies an earlier page, which a new one may replace"""


def page(scene: ViewerScene, *, pictures: Pictures, source: str) -> Page:
    """Return the page of a scene.

    Args:
        scene: scene of the viewer.
        pictures: pictures of its photographs.
        source: file or folder that the result was read from.
    """
    s, u = scene, scene.unit
    viewer = viewer_of(scene, pictures)
    counts = ((s.photographs, "photograph"), (s.points, "point"), (s.rays, "image point"))
    figures = facts(
        [
            ("Read from", source),
            ("Photographs", str(len(s.photographs))),
            ("Cameras", ", ".join(f"{camera.name} ({camera.model})" for camera in s.cameras)),
            ("Object points", str(len(s.points))),
            ("Image points", f"{len(s.rays)}, {s.rays.rejected.sum()} rejected"),
            (
                "RMS residual",
                "not known" if np.isnan(s.rms_px) else f"{fixed(s.rms_px, 4)} px per image coordinate",
            ),
        ]
    )
    columns = (
        Column("point"),
        *axes("", u, ".9g"),
        Column("rays", format=str),
        Column("angle", "", "deg", "z.1f"),
        Column("RMS", "", "px", "z.3f"),
    )
    rows = [
        (name, *xyz, *others)
        for name, xyz, *others in zip(
            s.points, s.xyz, s.rays_of_point, s.angle_deg, s.point_rms_px, strict=True
        )
    ]
    return Page(
        "view",
        "Result to explore",
        s.name,
        Banner(
            "good",
            f"{', '.join(counted(len(them), noun) for them, noun in counts)}.",
            tuple(Line("note", note) for note in viewer.notes),
        ),
        (Section("Figures", figures, FoldedParts("Object points", Table(columns, rows))),),
        viewer=viewer,
        pictures_beside=bool(pictures.beside),
    )


def view_page(scene: ViewerScene, pictures: Pictures, source: str) -> str:
    """Return the page of a scene as HTML, with the mark that identifies it."""
    text = html(page(scene, pictures=pictures, source=source))
    return text.replace("<!DOCTYPE html>\n", MARK.decode(), 1)


def write_view(
    scene: ViewerScene,
    out: Path,
    *,
    source: str,
    paths: Mapping[str, Path],
    budget_mb: float = BUDGET_MB,
    jobs: int = 1,
    progress: Progress = SILENT,
) -> Path:
    """Write the page of a scene, whole or not at all.

    Args:
        scene: scene of the viewer.
        out: path of the page; an earlier page is replaced, anything else there is an error.
        source: file or folder that the result was read from.
        paths: files of the photographs by name.
        budget_mb: maximum size of the pictures inside the page, 10^6 bytes.
        jobs: photographs processed at the same time.
        progress: called for every photograph.

    Raises:
        OutputError: something else exists at this path, or the page cannot be written.
    """
    refuse_foreign_page(out)
    pictures = cut_pictures(scene, paths, budget_mb=budget_mb, jobs=jobs, progress=progress)
    with whole_file(out, "the page", replaces=True) as part:
        part.write_text(view_page(scene, pictures, source), encoding="utf-8")
    return out


def refuse_foreign_page(out: Path) -> None:
    """Raise OutputError if a path exists and is not a page written by `kolinear view`."""
    if out.is_file() and not out.is_symlink():
        with disk_errors(f"{out}: cannot be read"), out.open("rb") as file:
            if file.read(len(MARK)) == MARK:
                return
    refuse_existing(out)


def photographs_in(folder: Path, names: tuple[str, ...]) -> dict[str, Path]:
    """Return the photographs of given names in a folder; names that lead out of the folder are left out."""
    root = folder.resolve()
    paths = {}
    for name in names:
        with suppress(OSError, ValueError):  # a name that is not a valid file name here
            path = (root / name).resolve()
            if path.is_relative_to(root) and path.is_file():
                paths[name] = path
    return paths
