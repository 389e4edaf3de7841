"""Videos, decoded frame by frame by PyAV of the extra kolinear[photographs].

Frames are given as stored, never turned, as photographs are. Their times are those of the file. What a
person should know of a video, such as dropped frames, is a list of sentences.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from sfm.model.conventions import AnyArray, FloatArray
from sfm.model.errors import PhotographError
from sfm.photographs.camera_files import is_installed

VIDEO = (".3gp", ".avi", ".insv", ".lrv", ".m2ts", ".m4v", ".mkv", ".mov", ".mp4", ".mpeg", ".mpg", ".mts",
         ".mxf", ".ogv", ".webm", ".wmv")  # fmt: skip
PREVIEW = ".lrv"  # a small copy beside the video of an action camera
# A playlist under the name of a video would let FFmpeg open other files and addresses.
CONTAINERS = "mov,mp4,m4a,3gp,3g2,mj2,avi,matroska,webm,mpegts,mpeg,mxf,ogg,asf"
PROTOCOLS = "file"
ORIENTATION = {0: 1, 90: 8, 180: 3, 270: 6}  # EXIF orientation by the counterclockwise turn for display, deg
TRANSFER = {16: "PQ", 18: "HLG"}  # names of tone curves of HDR by ITU-T H.273
MODEL = ("com.apple.quicktime.model", "com.android.model", "model")
MAKE = ("com.apple.quicktime.make", "com.android.manufacturer", "make")
MAX_FRAME_PIXELS = 150_000_000
MICROSECONDS = 1_000_000  # in a second: unit of the duration of a container
MAX_DAMAGED = 10_000  # frames: the rest of the file is not looked through
ROUNDING_S = 0.0011  # of times in Matroska, which are whole milliseconds


@dataclass(frozen=True)
class Frame:
    """A frame of a video."""

    index: int  # from 0, of all frames that can be decoded
    time_s: float  # since the first frame
    decoded: Any  # of PyAV

    def grey(self) -> AnyArray:
        """Return intensities, (H, W), uint8."""
        return np.asarray(self.decoded.to_ndarray(format="gray"))

    def colours(self) -> AnyArray:
        """Return red, green and blue, (H, W, 3), uint8."""
        return np.asarray(self.decoded.to_ndarray(format="rgb24"))


@dataclass
class Video:
    """A video that is open, and what was found of it so far."""

    path: Path
    container: Any  # of PyAV
    stream: Any  # of PyAV, its pictures
    make: str | None = None  # of the camera
    model: str | None = None
    orientation: int = 1  # EXIF orientation of all frames
    size_px: tuple[int, int] = (0, 0)  # width and height as stored
    duration_s: float = 0.0  # as stated; 0 if it is not
    times_s: list[float] = field(default_factory=list)  # of the frames that were decoded
    damaged_s: list[float] = field(default_factory=list)  # where frames could not be decoded
    kinds: tuple[str, ...] = ()  # sentences on the kind of the frames

    def frames(self) -> Iterator[Frame]:
        """Decode all frames; those that are damaged are left out.

        Damage that is valid code, such as some zeros, a decoder cannot know.

        Raises:
            PhotographError: there is no frame, or frames are too large.
        """
        self.times_s.clear()
        self.damaged_s.clear()
        for decoded, time_s in self._decoded():
            if not self.times_s:
                self._note_kind(decoded)
            self.times_s.append(time_s)
            yield Frame(len(self.times_s) - 1, time_s, decoded)
        if not self.times_s:
            raise PhotographError(f"{self.path.name}: a video without any frame that can be decoded")

    def _decoded(self) -> Iterator[tuple[Any, float]]:
        """Yield frames of PyAV with their times, s."""
        import av

        self.container.seek(0)
        rate = float(self.stream.average_rate or 25)
        first, count, whole = None, 0, True
        packets = self.container.demux(self.stream)
        while True:
            try:
                packet = next(packets, None)
                if packet is None:
                    return
                if packet.is_corrupt:  # a truncated one, whose error a decoder with threads loses
                    self.damaged_s.append(self.times_s[-1] if self.times_s else 0.0)
                decoded_frames = packet.decode()
            except (av.FFmpegError, EOFError, ValueError):
                whole = False  # what follows builds on what is missing, until a frame that stands alone
                self.damaged_s.append(self.times_s[-1] if self.times_s else 0.0)
                if len(self.damaged_s) > MAX_DAMAGED:
                    return
                continue
            for decoded in decoded_frames:
                time_s = count / rate if decoded.pts is None else float(decoded.pts * decoded.time_base)
                count += 1
                whole = whole or bool(decoded.key_frame)
                if decoded.is_corrupt or not whole:
                    self.damaged_s.append(self.times_s[-1] if self.times_s else 0.0)
                    continue
                first = time_s if first is None else first
                yield decoded, time_s - first

    def _note_kind(self, decoded: Any) -> None:
        """Note size, orientation and kind of the frames from the first one."""
        self.size_px = decoded.width, decoded.height
        if decoded.width * decoded.height > MAX_FRAME_PIXELS:
            raise PhotographError(f"{self.path.name}: frames of {decoded.width} x {decoded.height} px")
        self.orientation = ORIENTATION.get(round(decoded.rotation) % 360, 1)
        said = []
        bits = max((component.bits for component in decoded.format.components), default=8)
        if bits > 8:
            curve = TRANSFER.get(int(decoded.color_trc), "")
            said.append(f"{bits} bit{' ' + curve if curve else ''}: its frames are written with 8 bit")
        if decoded.interlaced_frame:
            said.append(
                "interlaced: rows of a frame are of two moments, which moves points; run a copy made by "
                f"ffmpeg -i {self.path.name} -vf yadif COPY.mkv"
            )
        aspect = self.stream.sample_aspect_ratio
        if aspect and aspect != 1:
            said.append(
                f"its pixels are {aspect.numerator}:{aspect.denominator}, not square: write pixel_mm with "
                "this ratio in the survey file"
            )
        self.kinds = tuple(said)

    def remarks(self) -> tuple[str, ...]:
        """Return a sentence on each thing that a person should know, after its frames were decoded."""
        times = np.array(self.times_s)
        said = [*self.kinds, *remarks_on_times(times)]
        last, period = float(times[-1]), float(np.median(np.diff(times))) if len(times) > 1 else 0.0
        missing = self.duration_s - last - period
        if missing > max(2 * period, 0.5 if not self.damaged_s else 0.0):
            said.append(
                f"its end cannot be read: {last:.1f} of {self.duration_s:.1f} s are used; copy it again"
            )
        elif self.damaged_s:
            said.append(f"damaged frames are left out, the first after {self.damaged_s[0]:.2f} s")
        return tuple(said)


def missing_av() -> bool:
    """Return whether the library that reads videos is not installed."""
    return not is_installed("av")


def is_video(path: Path) -> bool:
    """Return whether a path is a file with the ending of a video."""
    return path.suffix.lower() in VIDEO and path.is_file()


@contextmanager
def opened_video(path: Path) -> Iterator[Video]:
    """Open a video without decoding its frames.

    Args:
        path: the file.

    Raises:
        PhotographError: the file does not exist, has no video, or cannot be read.
    """
    import av

    if not path.is_file():
        raise PhotographError(f"{path.name}: {'not a file' if path.exists() else 'no such file'}")
    av.logging.set_level(None)
    try:
        container = av.open(
            f"file:{os.path.abspath(path)}",
            options={"format_whitelist": CONTAINERS, "protocol_whitelist": PROTOCOLS},
            metadata_errors="replace",
        )
    except (av.FFmpegError, OSError, ValueError) as error:
        reason = (getattr(error, "strerror", None) or "cannot be opened").rstrip(".")
        raise PhotographError(
            f"{path.name}: not a video that can be read ({reason}); copy it again, or convert it to MP4"
        ) from error
    with container:
        pictures = [stream for stream in container.streams.video if not _is_cover(stream)]
        if not pictures:
            kinds = sorted({"a cover" if _is_cover(stream) else stream.type for stream in container.streams})
            content = " and ".join(kinds) or "nothing"
            raise PhotographError(f"{path.name}: has no video, only {content}; give a file with pictures")
        stream = pictures[0]
        stream.thread_type = "AUTO"
        stream.codec_context.options = {"err_detect": "explode"}  # an error, not a frame made up
        stated = float(container.duration or 0) / MICROSECONDS
        if stream.duration and stream.time_base:
            stated = float(stream.duration * stream.time_base)
        described = {name.lower(): value for name, value in container.metadata.items()}
        yield Video(
            path,
            container,
            stream,
            make=next((described[name] for name in MAKE if described.get(name)), None),
            model=next((described[name] for name in MODEL if described.get(name)), None),
            duration_s=stated,
        )


def _is_cover(stream: Any) -> bool:
    """Return whether a stream is the picture of a piece of music."""
    return "attached_pic" in str(getattr(stream.disposition, "name", None) or stream.disposition).lower()


def remarks_on_times(times_s: FloatArray) -> tuple[str, ...]:
    """Return a sentence on dropped frames and one on a variable rate, if there are any.

    Args:
        times_s: times of the frames, s, (k,).
    """
    if len(times_s) == 1:
        return ("one frame only: photograph the object from several places",)
    steps = np.diff(times_s)
    usual = float(np.median(steps))
    if usual <= 0:
        return ("the times of its frames do not increase",)
    periods = np.round(steps / usual)
    uneven = (np.abs(steps - usual) > ROUNDING_S) & (periods <= 1)
    if uneven.any():
        slow, fast = (1 / float(np.quantile(steps, share)) for share in (0.99, 0.01))
        return (
            f"variable frame rate, {slow:.3g} to {fast:.3g} frames a second: the times of the file are used",
        )
    gaps = np.flatnonzero(periods > 1)
    if not len(gaps):
        return ()
    missing = int((periods[gaps] - 1).sum())
    words = "frame was" if missing == 1 else "frames were"
    return (f"{missing} {words} dropped by the camera, the first after {times_s[gaps[0]]:.2f} s",)
