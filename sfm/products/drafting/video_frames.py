"""Frames of videos as photographs: sharp ones, spaced by how far the camera has moved.

The way of the camera is followed by points that are tracked from frame to frame. It is measured by the angle
between the directions in which the object is seen: a shift of the picture over the principal distance, and a
change of the figure of the points over its size. An object in the middle of the picture, around which the
camera moves, changes its figure; a wall along which it moves shifts.

Frames are evenly spaced on this way, whatever the speed, so a camera that stands still gives one frame. Of
the frames near each place the sharpest is taken. A blurred one is left out if its neighbours can be matched.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
from PIL import ExifTags, Image

from sfm.files.plain_text import as_plain
from sfm.model.conventions import AnyArray, FloatArray, IntArray
from sfm.model.display import counted
from sfm.model.errors import PhotographError
from sfm.photographs.video_files import Video, opened_video
from sfm.products.drafting.camera_groups import FOCAL_PER_SIDE
from sfm.products.drafting.video_clocks import ClockDifference, clock_difference
from sfm.runtime.progress import SILENT, Progress

# Directions that differ by more are not matched well by any detector (Moreels and Perona 2007, IJCV 73). A
# point needs three photographs to be checked, so this is the largest angle of neighbours but one.
MATCHED_RAD = math.radians(25.0)
REACH = 0.25  # of the spacing: how far from its place the sharpest frame is searched
# Neighbours but one are at most two spacings and two reaches apart.
SPACING_RAD = MATCHED_RAD / (2 + 2 * REACH)
FINE_RAD = SPACING_RAD / 4  # after which points are chosen anew; a hand that holds still moves less
TRACKED_SIDE_PX = 640  # longer side of the pictures in which points are tracked
POINTS, MIN_POINTS = 300, 8
LARGER = 0.75  # quantile of motion: an object that turns before its background has a quarter of the points
BACK_PX = 0.5  # largest distance of a point that is tracked there and back
SAME_PLACE_RAD = math.radians(0.01)  # 0.1 px of full HD, as well as targets in videos are measured
QUALITY = 98  # of the JPEG files: their noise is below that of the video


@dataclass(frozen=True)
class Way:
    """The way of a camera along a video."""

    times_s: FloatArray  # of the frames, (k,)
    way_rad: FloatArray  # from the first frame to each, never less than before, (k,)
    sharpness: FloatArray  # comparable between frames of one scene, (k,)
    speed: FloatArray  # of the apparent motion, rad/s, NaN where it is not known, (k,)
    followed: bool = True  # whether any points could be followed

    @property
    def motion(self) -> tuple[FloatArray, FloatArray]:
        """Times of the frames, s, and the speed of the apparent motion."""
        return self.times_s, self.speed


class _Tracker:
    """Follows points from frame to frame and adds up the way."""

    def __init__(self) -> None:
        self._base = 0.0  # way up to the picture in which the points were chosen
        self._since = 0.0  # farthest since then
        self._picture: AnyArray | None = None  # last one with points
        self._start = np.zeros((0, 2), np.float32)  # points where they were chosen, and where they are now
        self._now = self._start
        self._chosen = 0
        self._lost: AnyArray | None = None  # last picture in which the points were lost
        self.moved = math.nan  # median motion of the points since the last picture, rad; NaN if not known

    @property
    def way(self) -> float:
        """Angle from the first frame, rad."""
        return self._base + self._since

    @property
    def has_points(self) -> bool:
        """Whether a picture had points."""
        return self._picture is not None

    def add(self, picture: AnyArray) -> None:
        """Follow the points into the next picture, (H, W), uint8."""
        self.moved = math.nan
        if self._picture is None:
            self._choose(picture)
            return
        moved, kept = _tracked(self._picture, picture, self._now)
        if 2 * kept.sum() >= self._chosen and kept.sum() >= MIN_POINTS:
            shift = np.median(np.linalg.norm((moved - self._now)[kept], axis=1))
            self.moved = float(shift) / (FOCAL_PER_SIDE * max(picture.shape))
            self._start, self._now = self._start[kept], moved[kept]
            self._picture, self._lost = picture, None
            self._since = max(self._since, _angle(self._start, self._now, max(picture.shape)))
            if self._since >= FINE_RAD:
                self._choose(picture)
        elif self._lost is None:  # blurred perhaps: the next picture may show the points again
            self._lost = picture
        else:
            points = _points(self._lost)
            _, kept = _tracked(self._lost, picture, points)
            self._lost = picture
            if 2 * kept.sum() >= len(points) >= MIN_POINTS:  # another scene, or far away
                self._since += SPACING_RAD
                self._choose(picture)

    def _choose(self, picture: AnyArray) -> None:
        """Choose points in a picture, from which the way is continued."""
        points = _points(picture)
        if len(points) < MIN_POINTS and self._picture is not None:
            return
        self._base, self._since = self.way, 0.0
        self._start = self._now = points
        self._chosen, self._picture, self._lost = len(points), picture, None
        if len(points) < MIN_POINTS:  # such as a black first frame
            self._picture = None


def follow_camera(video: Video, progress: Progress = SILENT) -> Way:
    """Return the way of the camera along a video, and how sharp its frames are.

    Args:
        video: an open video, all of whose frames are decoded.
        progress: receives a step for every frame.

    Raises:
        PhotographError: no frame can be decoded.
    """
    tracker, way, sharpness, moved = _Tracker(), list[float](), list[float](), list[float]()

    def power(picture: AnyArray) -> float:
        """Return the power of gradients from pixel to pixel."""
        down = cv2.norm(picture[1:], picture[:-1], cv2.NORM_L2SQR)
        across = cv2.norm(picture[:, 1:], picture[:, :-1], cv2.NORM_L2SQR)
        return (down + across) / picture.size

    for frame in video.frames():
        grey = frame.grey()
        factor = min(1.0, TRACKED_SIDE_PX / max(grey.shape))
        size = max(1, round(factor * grey.shape[1])), max(1, round(factor * grey.shape[0]))
        small = np.asarray(cv2.resize(grey, size, interpolation=cv2.INTER_AREA))
        tracker.add(small)
        way.append(tracker.way)
        moved.append(tracker.moved)
        coarse = cv2.resize(grey, None, fx=0.25, fy=0.25, interpolation=cv2.INTER_AREA)
        sharpness.append(power(grey) / max(power(np.asarray(coarse)), 1e-6))
        progress.advance(f"{frame.time_s:.1f} s")
    times = np.array(video.times_s)
    speed = np.array(moved) / np.maximum(np.diff(times, prepend=times[0]), 1e-3)
    return Way(times, np.array(way), np.array(sharpness), speed, tracker.has_points)


def choose_frames(way: Way, count: int | None = None) -> IntArray:
    """Return the frames to use, in order, (n,).

    Args:
        way: that of the camera.
        count: number of frames; fewer are chosen where the camera stands still. None: as many as neighbours
            need that have points in common.
    """
    total = float(way.way_rad[-1])
    places = np.linspace(0, total, count or round(total / SPACING_RAD) + 1)
    if len(places) == 1:
        return np.array([int(np.argmax(way.sharpness))], dtype=np.int64)
    spacing = total / (len(places) - 1)
    found = [_frame_near(place, spacing, way) for place in places]
    chosen = np.unique([frame for frame, _ in found])
    if count is None:
        for frame in sorted({frame for frame, sharp in found if not sharp}):
            k = int(np.searchsorted(chosen, frame))
            beside = chosen[[max(k - 1, 0), min(k + 1, len(chosen) - 1)]]
            if 0 < k < len(chosen) - 1 and np.ptp(way.way_rad[beside]) <= MATCHED_RAD:
                chosen = np.delete(chosen, k)
    return np.asarray(chosen, dtype=np.int64)


def _frame_near(place: float, spacing: float, way: Way) -> tuple[int, bool]:
    """Return the frame to take near a place of the way, and whether it is as sharp as most there.

    It is the sharpest in reach. If that is blurred, a sharp one within half of the spacing is better: so far
    from their places, neighbours are two spacings apart, which are still matched.
    """
    away = np.abs(way.way_rad - place)

    def within(distance: float) -> IntArray:
        return np.flatnonzero(away <= max(distance, away.min()))

    near = within(REACH * spacing)
    best = int(near[np.argmax(way.sharpness[near])])
    usual = np.median(way.sharpness[within(spacing)])
    if way.sharpness[best] >= usual:
        return best, True
    sharp = [k for k in within(spacing / 2).tolist() if way.sharpness[k] >= usual]
    return (min(sharp, key=lambda k: away[k]), True) if sharp else (best, False)


@dataclass(frozen=True)
class ChosenFrames:
    """The frames of a video to use."""

    frames: IntArray  # in order, (n,)
    moments_s: FloatArray  # times by which they are named, those of frames of other videos too, (n,)
    reference: int | None = None  # number of the video that this one moves together with
    ahead_s: float = 0.0  # of its clock
    shared: int = 0  # frames of one moment with those of that video


def choose_of_all(ways: Sequence[Way], count: int | None = None) -> tuple[ChosenFrames, ...]:
    """Return the frames of videos to use, near one another in time where cameras move together.

    Frames are of one moment where the cameras hardly moved between them.

    Args:
        ways: those of the cameras.
        count: see `choose_frames`.
    """
    chosen = dict[int, ChosenFrames]()
    for first, way in enumerate(ways):
        if first in chosen:
            continue
        mounted = {
            k: clock
            for k, other in enumerate(ways[first + 1 :], first + 1)
            if k not in chosen and (clock := clock_difference(way.motion, other.motion)) is not None
        }
        joint = _joint_way(way, [(ways[k], clock) for k, clock in mounted.items()]) if mounted else way
        frames = choose_frames(joint, count)
        at = way.times_s[frames]
        chosen[first] = ChosenFrames(frames, at)
        for k, clock in mounted.items():
            nearest, moved = _nearest(ways[k], at, clock)
            filmed = np.isfinite(moved)  # else the video begins later, or has ended
            nearest, places = np.unique(nearest[filmed], return_index=True)
            shared = moved[filmed][places] <= SAME_PLACE_RAD
            moment_of = dict(zip(nearest[shared].tolist(), at[filmed][places][shared].tolist(), strict=True))
            frames_of = _with_frames_outside(nearest, ways[k], way, clock, count)
            if not len(frames_of):
                frames_of = choose_frames(ways[k], count)
            own = np.maximum(ways[k].times_s[frames_of] - clock.ahead_s, 0.0)
            own[np.isin(np.round(1000 * own), np.round(1000 * at))] += 0.001  # such names state one moment
            moments = [
                moment_of.get(frame, time) for frame, time in zip(frames_of.tolist(), own, strict=True)
            ]
            shown = int(np.isin(frames_of, list(moment_of)).sum())
            chosen[k] = ChosenFrames(frames_of, np.array(moments), first, clock.ahead_s, shown)
    return tuple(chosen[k] for k in range(len(ways)))


def _with_frames_outside(
    inside: IntArray, way: Way, reference: Way, clock: ClockDifference, count: int | None
) -> IntArray:
    """Return the frames of a video, in order, with those before another begins and after it ends.

    A stated number of frames is divided by how far the camera moves within the other video and outside.

    Args:
        inside: frames near those of the other video.
        way: that of the camera.
        reference: that of the camera of the other video.
        clock: of the camera.
        count: see `choose_frames`.
    """
    at = way.times_s - clock.ahead_s
    parts = []
    for outside in (at < reference.times_s[0], at > reference.times_s[-1]):
        rows = np.flatnonzero(outside)
        if len(rows) and np.ptp(way.way_rad[rows]) >= SPACING_RAD:
            parts.append(rows)
    numbers: list[int | None] = [None] * len(parts)
    if count is not None:
        gone = [float(np.ptp(way.way_rad[rows])) for rows in parts]
        of_all = max(float(np.ptp(way.way_rad)), sum(gone))
        # what the other video lacks of them is outside of it
        shares = [max(part / of_all, part / sum(gone) * (1 - len(inside) / count)) for part in gone]
        up_to = np.minimum(np.round(count * np.cumsum(shares)), count).astype(int).tolist()
        numbers = list(np.diff([0, *up_to]).tolist())
        left = count - max(up_to, default=0)
        if left < len(inside):
            inside = inside[np.unique(np.linspace(0, len(inside) - 1, left).round().astype(np.int64))]
    frames = [inside]
    for rows, number in zip(parts, numbers, strict=True):
        if number != 0:
            part = Way(
                way.times_s[rows],
                way.way_rad[rows] - way.way_rad[rows[0]],
                way.sharpness[rows],
                way.speed[rows],
            )
            frames.append(rows[choose_frames(part, number)])
    return np.unique(np.concatenate(frames))


def _nearest(way: Way, at: FloatArray, clock: ClockDifference) -> tuple[IntArray, FloatArray]:
    """Return the frames nearest to moments, and how far the camera may have moved between, rad, (n,).

    It is infinite where no frame is near.

    Args:
        way: that of the camera.
        at: times of the moments by the clock of the reference, s, (n,).
        clock: of the camera.
    """
    nearest = np.abs(way.times_s - (at + clock.ahead_s)[:, None]).argmin(axis=1)
    apart = np.abs(way.times_s[nearest] - at - clock.ahead_s)
    moved = np.nan_to_num(way.speed[nearest], nan=np.inf) * np.hypot(apart, clock.sigma_s)
    return nearest, np.where(apart <= np.median(np.diff(way.times_s)), moved, np.inf)


def _joint_way(reference: Way, others: Sequence[tuple[Way, ClockDifference]]) -> Way:
    """Return the way that the fastest of cameras goes, and how sharp the least sharp frame of a moment is.

    A moment at which a camera moves between its frame and that of the reference counts as less sharp.

    others: ways of the other cameras, and their clocks.
    """
    ways, sharpness = [reference.way_rad], [_relative(reference.sharpness)]
    for other, clock in others:
        at = reference.times_s + clock.ahead_s
        ways.append(np.interp(at, other.times_s, other.way_rad))
        nearest, moved = _nearest(other, reference.times_s, clock)
        relative = _relative(other.sharpness)[nearest]
        sharpness.append(relative / (1 + np.where(np.isfinite(moved), moved, 0.0) / SAME_PLACE_RAD))
    gone = np.diff(ways, axis=1, prepend=0.0).max(axis=0)
    gone[0] = 0.0
    return replace(reference, way_rad=np.cumsum(gone), sharpness=np.min(sharpness, axis=0))


def _relative(sharpness: FloatArray) -> FloatArray:
    """Return the sharpness of frames over the usual one of their video, most of which may be black."""
    usual = float(np.median(sharpness))
    return sharpness / usual if usual > 0 else sharpness


def write_frames(
    video: Video, chosen: ChosenFrames, folder: Path, name: str, progress: Progress = SILENT
) -> tuple[str, ...]:
    """Write frames as JPEG files whose EXIF data state one camera; return their names.

    Args:
        video: an open video.
        chosen: the frames.
        folder: where they are written.
        name: begins their names, and tells the cameras of several videos apart.
        progress: receives a step for every frame that is decoded.

    Raises:
        PhotographError: a frame cannot be decoded any more.
    """
    wanted = dict(zip(chosen.frames.tolist(), chosen.moments_s.tolist(), strict=True))
    names = list[str]()
    progress.stage("writing", max(wanted) + 1)
    for frame in video.frames():
        progress.advance(f"{frame.time_s:.1f} s")
        if frame.index in wanted:
            names.append(f"{name}-{round(1000 * wanted[frame.index]):07d}ms.jpg")
            exif = Image.Exif()
            exif[ExifTags.Base.Model] = _plain(f"{video.model or ''} {name}".strip())
            if video.make:
                exif[ExifTags.Base.Make] = _plain(video.make)
            exif[ExifTags.Base.Orientation] = video.orientation
            exif[ExifTags.Base.ImageDescription] = f"{frame.time_s:.3f} s of {_plain(video.path.name)}"
            picture = Image.fromarray(frame.colours())
            picture.save(folder / names[-1], quality=QUALITY, subsampling=0, exif=exif)
        if len(names) == len(wanted):
            return tuple(names)
    raise PhotographError(f"{video.path.name}: changed while it was read")


def _plain(text: str | None) -> str:
    """Return a text of the file as EXIF data can state it, different for different texts."""
    return as_plain(text or "").encode("ascii", "backslashreplace").decode("ascii")


def _points(picture: AnyArray) -> AnyArray:
    """Return corners of a picture, evenly spread, (n, 2), float32."""
    apart = math.sqrt(picture.size / POINTS) / 2
    corners = cv2.goodFeaturesToTrack(picture, POINTS, 0.01, apart)
    return np.zeros((0, 2), np.float32) if corners is None else np.asarray(corners.reshape(-1, 2))


def _tracked(first: AnyArray, second: AnyArray, points: AnyArray) -> tuple[AnyArray, AnyArray]:
    """Return points of one picture in another, (n, 2), and which are found there and back, (n,)."""
    if not len(points):
        return points, np.zeros(0, dtype=bool)
    there, found, _ = cv2.calcOpticalFlowPyrLK(first, second, points, None)  # type: ignore[call-overload]
    back, found_back, _ = cv2.calcOpticalFlowPyrLK(second, first, there, None)  # type: ignore[call-overload]
    near = np.linalg.norm(back - points, axis=1) <= BACK_PX
    return there, (found.ravel() == 1) & (found_back.ravel() == 1) & near


def _angle(start: AnyArray, now: AnyArray, side_px: int) -> float:
    """Return the angle by which a camera sees points from elsewhere, rad.

    Args:
        start: points in the first picture, (n, 2).
        now: the same in the second, (n, 2).
        side_px: longer side of the pictures.
    """
    moved = now - start
    shift = np.median(moved, axis=0)
    size = np.quantile(np.linalg.norm(start - np.median(start, axis=0), axis=1), LARGER)
    figure = np.quantile(np.linalg.norm(moved - shift, axis=1), LARGER) / max(float(size), 1.0)
    return float(np.hypot(np.linalg.norm(shift) / (FOCAL_PER_SIDE * side_px), figure))


@dataclass(frozen=True)
class WrittenFrames:
    """The frames that were taken of a video."""

    video: Path
    names: tuple[str, ...]
    frames: int  # that the video has
    seconds: float  # of the last one
    said: tuple[str, ...]  # sentences for the person


def extract_frames(
    videos: Sequence[Path], folder: Path, *, count: int | None = None, progress: Progress = SILENT
) -> tuple[WrittenFrames, ...]:
    """Write sharp frames of videos, spaced by the motion of the camera, as photographs.

    Frames of videos that move together are taken near the same moments. Those of one moment, where the
    cameras stand still, have the same time in their names.

    Args:
        videos: files; each is a camera.
        folder: an empty folder.
        count: number of frames of each; None for as many as are needed.
        progress: receives the frames.

    Raises:
        PhotographError: a video cannot be read.
    """
    ways, remarks = list[Way](), list[list[str]]()
    for path in videos:
        with opened_video(path) as video:
            progress.stage("frames", video.stream.frames or None)
            ways.append(follow_camera(video, progress))
            remarks.append(list(video.remarks()))
    written = []
    for path, way, chosen, said in zip(videos, ways, choose_of_all(ways, count), remarks, strict=True):
        if chosen.reference is not None:
            name = as_plain(videos[chosen.reference].name)
            later = f"{abs(chosen.ahead_s):.2f} s {'later' if chosen.ahead_s < 0 else 'earlier'}"
            shared = (
                f"{chosen.shared} of {counted(len(chosen.frames), 'frame')} show a moment of that video, "
                "where the cameras stand still, and have the same time in their names"
                if chosen.shared
                else "no frame shows a moment of that video, as the cameras move; stop at each place"
            )
            said.append(f"moves together with {name} and begins {later}: {shared}")
        alike = [other for other in videos if other.stem.casefold() == path.stem.casefold()]
        name = as_plain(path.stem if len(alike) < 2 else path.name.replace(".", "-"))
        with opened_video(path) as video:
            names = write_frames(video, chosen, folder, name, progress)
        if len(names) == 1 < len(way.times_s):
            why = "the camera does not move" if way.followed else "its pictures show nothing to follow"
            said.append(f"{why}: one frame is taken; film the object from several places, in good light")
        elif count is not None and len(names) < count:
            said.append(f"only {len(names)} of {count} frames are of different places")
        written.append(WrittenFrames(path, names, len(way.times_s), float(way.times_s[-1]), tuple(said)))
    return tuple(written)
