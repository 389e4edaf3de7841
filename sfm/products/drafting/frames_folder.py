"""Folders of frames that were taken of videos: photographs beside the survey file that is drafted for them.

The folder lists its videos, so that a second run takes the frames that are there, and takes them anew once a
video has changed.
"""

from __future__ import annotations

import json
import os
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

from sfm.files.globs import find_files
from sfm.files.plain_text import as_plain
from sfm.files.whole_files import whole_folder
from sfm.model.display import counted
from sfm.model.errors import OutputError, PhotographError
from sfm.photographs.exif import conversion_of
from sfm.photographs.reading import SUFFIXES
from sfm.photographs.video_files import PREVIEW, VIDEO, is_video, missing_av
from sfm.products.drafting.video_frames import extract_frames
from sfm.runtime.progress import SILENT, Progress

ENDING = "-frames"  # of the folder, after the name of the survey file
LIST = "frames.json"


def frames_beside(file: Path) -> Path:
    """Return the folder of frames that belongs to a survey file."""
    return file.with_name(f"{file.stem}{ENDING}")


def videos_of(source: Path) -> tuple[Path, ...]:
    """Return the videos whose frames take the place of photographs; none if there are photographs.

    Args:
        source: a video, or a folder.
    """
    if not source.is_dir():
        return (source,) if is_video(source) else ()
    files = find_files(source, "*", hidden=False)
    if any(path.suffix.lower() in SUFFIXES for path in files):
        return ()
    videos = [path for path in files if path.suffix.lower() in VIDEO]
    return tuple([path for path in videos if path.suffix.lower() != PREVIEW] or videos)


def source_of(folder: Path) -> Path:
    """Return the video or folder of videos whose frames a folder contains, else the folder itself."""
    stated = _read_list(folder).get("source")
    return folder / stated if isinstance(stated, str) else folder


def take_frames(
    source: Path,
    folder: Path,
    *,
    count: int | None = None,
    tell: Callable[[str], None] = lambda _: None,
    progress: Progress = SILENT,
) -> None:
    """Write the frames of videos into a folder, unless they are there.

    Args:
        source: a video, or a folder of videos.
        folder: new folder, or one of frames of the same videos.
        count: number of frames of each video; None for as many as are needed, or as are there.
        tell: receives a line on each thing that a person should know.
        progress: receives the frames.

    Raises:
        PhotographError: a video cannot be read, or the library that reads videos is not installed.
        OutputError: the folder has other content, or cannot be written.
    """
    videos = videos_of(source)
    if missing_av():
        raise PhotographError(f"{videos[0]}: {conversion_of(videos[0])}")
    before = _read_list(folder)
    state = [(path.name, path.stat().st_size, path.stat().st_mtime_ns) for path in videos]
    now = {
        "source": os.path.relpath(source.resolve(), folder.resolve()),
        "videos": [{"name": name, "bytes": size, "modified_ns": at} for name, size, at in state],
        "count": count,
    }
    same = before.get("source") == now["source"] and before.get("videos") == now["videos"]
    if same and count in (None, before.get("count")):
        tell(f"Frames: {folder}, which exists; remove it to take others")
        return
    if before and before.get("source") != now["source"]:
        raise OutputError(f"{folder}: has frames of {as_plain(str(source_of(folder)))}; choose another --out")
    with whole_folder(folder, "frames", replaceable=True) as part:
        for written in extract_frames(videos, part, count=count, progress=progress):
            name = as_plain(written.video.name)
            tell(
                f"{name}: {counted(len(written.names), 'frame')} of {written.frames}, {written.seconds:.1f} s"
            )
            for sentence in written.said:
                tell(f"! {name}: {sentence}.")
        (part / LIST).write_text(json.dumps(now, indent=1) + "\n", encoding="utf-8")
    tell(f"Frames: {folder}")


def count_of(folder: Path) -> int | None:
    """Return the number of frames that was asked for when a folder was written."""
    count = _read_list(folder).get("count")
    return count if isinstance(count, int) else None


def _read_list(folder: Path) -> dict[str, Any]:
    """Return the list of a folder, empty without one."""
    with suppress(OSError, ValueError, RecursionError):
        listed: Any = json.loads((folder / LIST).read_text(encoding="utf-8"))
        if isinstance(listed, dict):
            return listed
    return {}
