"""Frames of videos: sharp, spaced by the motion of the camera, with the times and the turn of the file."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import ExifTags, Image

from sfm.model.conventions import AnyArray
from sfm.photographs import video_files
from sfm.photographs.exif import read_metadata
from sfm.photographs.reading import read_photograph
from sfm.photographs.video_files import opened_video, remarks_on_times
from sfm.products.drafting.frames_folder import LIST
from sfm.products.drafting.video_frames import (
    MATCHED_RAD,
    SPACING_RAD,
    Way,
    choose_frames,
    extract_frames,
    follow_camera,
)
from sfm.runtime.progress import Silent
from sfm.survey.inputs.survey_file import read_survey_file
from tests.commands import kolinear, refused
from tests.surveys import code_centres
from tests.tables import rows_of
from tests.videos import orbit, rendered, write_video

pytest.importorskip("av")
RATE = 25


def way_of(path: Path) -> Way:
    with opened_video(path) as video:
        return follow_camera(video)


@pytest.fixture(scope="module")
def around() -> list[AnyArray]:
    """A tenth of a turn in 40 frames, and then as much in 10."""
    angles = np.concatenate([np.linspace(0, 0.63, 40), np.linspace(0.63, 1.26, 11)[1:]])
    return orbit(angles)


def test_the_way_is_the_angle_between_directions_whatever_the_speed(
    around: list[AnyArray], tmp_path: Path
) -> None:
    way = way_of(write_video(tmp_path / "a.mp4", around))
    assert len(way.way_rad) == len(around)
    assert way.way_rad[-1] == pytest.approx(1.26, rel=0.15)
    assert way.way_rad[39] == pytest.approx(0.63, rel=0.15)
    chosen = choose_frames(way)
    assert len(chosen) == round(way.way_rad[-1] / SPACING_RAD) + 1
    assert (chosen < 40).sum() == pytest.approx((chosen >= 40).sum(), abs=1), "by the way, not by the time"
    assert np.diff(way.way_rad[chosen]).max() < 1.6 * SPACING_RAD


def test_a_camera_that_stands_still_gives_one_frame(around: list[AnyArray], tmp_path: Path) -> None:
    still = orbit(np.zeros(30))
    way = way_of(write_video(tmp_path / "still.mp4", still))
    assert len(choose_frames(way)) == 1
    assert len(choose_frames(way, 12)) == 1 or way.way_rad[-1] > 0
    paused = [*around[:20], *(around[20] for _ in range(60)), *around[20:]]
    way = way_of(write_video(tmp_path / "paused.mp4", paused))
    chosen = choose_frames(way)
    assert ((chosen >= 20) & (chosen < 80)).sum() <= 1
    assert len(chosen) == pytest.approx(len(choose_frames(way_of(tmp_path / "paused.mp4"))), abs=1)


def test_blurred_frames_are_not_taken(tmp_path: Path) -> None:
    frames = orbit(np.linspace(0, 0.8, 60))
    blurred = {k for k in range(60) if k % 4 in (1, 2)}
    frames = [cv2.blur(frame, (9, 1)) if k in blurred else frame for k, frame in enumerate(frames)]
    chosen = choose_frames(way_of(write_video(tmp_path / "a.mkv", frames)))
    assert len(chosen) > 3 and not blurred & set(chosen.tolist())


@pytest.mark.parametrize("seed", range(4))
def test_blurred_frames_of_a_fast_camera_are_passed_over(seed: int) -> None:
    """With hardly more than two frames for each place, and no more than two places from one to the next."""
    rng = np.random.default_rng(seed)
    blurred = rng.uniform(size=200) < 0.4
    sharpness = np.where(blurred, 0.13, 0.19) + rng.normal(0, 0.005, 200)
    way = Way(np.arange(200) / 10, np.cumsum(rng.uniform(0.05, 0.09, 200)), sharpness, np.ones(200))
    chosen = choose_frames(way)
    assert blurred[chosen].mean() < 0.2 < 0.3 < blurred.mean()
    assert np.diff(way.way_rad[chosen]).max() < MATCHED_RAD * 1.1
    assert len(choose_frames(way, 60)) > 55


def test_frames_in_which_nothing_can_be_followed_end_no_way(tmp_path: Path) -> None:
    frames = orbit(np.linspace(0, 0.5, 30))
    black = np.zeros_like(frames[0])
    with_black = [black, *frames[:14], black, *frames[14:]]
    way = way_of(write_video(tmp_path / "a.mp4", with_black))
    assert way.way_rad[-1] == pytest.approx(0.5, rel=0.2)
    other = orbit(np.linspace(2.0, 2.3, 12), seed="another")
    chosen = choose_frames(way_of(write_video(tmp_path / "cut.mp4", [*frames, *other])))
    assert (chosen < 30).sum() > 2 and (chosen >= 30).sum() > 1, "both sides of a cut"


def test_an_object_that_turns_before_a_background_is_followed(tmp_path: Path) -> None:
    """As on a turntable; something small that moves before a fixed camera is no motion of it."""
    background, turning = orbit(np.zeros(1))[0], orbit(np.linspace(0, 0.9, 40), seed="object")

    def before(share: float) -> list[AnyArray]:
        height, width = background.shape
        rows, columns = (round(side * (1 - np.sqrt(share)) / 2) for side in (height, width))
        frames = []
        for picture in turning:
            frame = background.copy()
            inside = slice(rows, height - rows), slice(columns, width - columns)
            frame[inside] = picture[inside]
            frames.append(frame)
        return frames

    assert len(choose_frames(way_of(write_video(tmp_path / "table.mp4", before(0.5))))) >= 4
    assert len(choose_frames(way_of(write_video(tmp_path / "person.mp4", before(0.05))))) == 1


@pytest.mark.parametrize("count", [2, 5, 12])
def test_as_many_frames_as_asked_for(count: int, around: list[AnyArray], tmp_path: Path) -> None:
    chosen = choose_frames(way_of(write_video(tmp_path / "a.mp4", around)), count)
    assert len(chosen) == count and (np.diff(chosen) > 0).all()


@pytest.mark.parametrize(("turn", "orientation"), [(0, 1), (90, 8), (180, 3), (-90, 6)])
def test_files_have_time_camera_and_orientation(
    turn: int, orientation: int, around: list[AnyArray], tmp_path: Path
) -> None:
    metadata = {"com.apple.quicktime.make": "Maker", "com.apple.quicktime.model": "Phone 7"}
    times = [0.04 * k + (0.5 if k >= 20 else 0.0) for k in range(len(around))]
    video = write_video(tmp_path / "Clip ü.mov", around, times_s=times, rotation=turn, metadata=metadata)
    folder = tmp_path / "frames"
    folder.mkdir()
    (written,) = extract_frames([video], folder)
    for name in written.names:
        found = read_metadata(folder / name)
        assert (found.make, found.model, found.orientation) == ("Maker", r"Phone 7 Clip \xfc", orientation)
        assert found.size_px == (480, 360) and read_photograph(folder / name).shape == (360, 480)
        at = float(name.split("-")[-1].removesuffix("ms.jpg")) / 1000
        k = int(np.argmin(np.abs(np.array(times) - at)))
        assert at == pytest.approx(times[k], abs=0.001)
        difference = read_photograph(folder / name).astype(int) - around[k]
        assert np.abs(difference).mean() < 4, "the frame of its time"
        with Image.open(folder / name) as image:
            assert image.getexif()[ExifTags.Base.ImageDescription].startswith(f"{at:.3f} s of Clip")
    assert any("dropped" in sentence for sentence in written.said)


def test_times_that_are_not_regular_are_named() -> None:
    regular = np.arange(100) / 29.97
    assert remarks_on_times(regular) == ()
    assert remarks_on_times(np.round(regular, 3)) == (), "whole milliseconds"
    (said,) = remarks_on_times(np.delete(regular, [40, 41, 70]))
    assert said.startswith("3 frames were dropped") and f"{regular[39]:.2f} s" in said
    uneven = np.cumsum(np.random.default_rng(1).uniform(0.02, 0.05, 100))
    (said,) = remarks_on_times(uneven)
    assert said.startswith("variable frame rate, 20")


def test_kinds_of_frames_are_named(around: list[AnyArray], tmp_path: Path) -> None:
    frames = around[:6]
    write_video(
        tmp_path / "deep.mov", frames, codec="libx265", pixels="yuv420p10le", colours={"color_trc": 18}
    )
    with opened_video(tmp_path / "deep.mov") as video:
        read = [frame.grey() for frame in video.frames()]
        assert any(said.startswith("10 bit HLG") for said in video.remarks())
    assert np.abs(read[0].astype(int) - frames[0]).mean() < 4
    with opened_video(write_video(tmp_path / "grey.mkv", frames, codec="ffv1", pixels="gray")) as video:
        read = [frame.grey() for frame in video.frames()]
        assert not video.remarks()
    np.testing.assert_allclose(read[3].astype(int), frames[3], atol=1)


@pytest.mark.parametrize("ending", [".mkv", ".avi", ".ts"])
def test_a_video_with_a_broken_end_is_used_until_there(
    ending: str, around: list[AnyArray], tmp_path: Path
) -> None:
    container = {".ts": ".m2ts"}.get(ending, ending)
    codec = "mpeg4" if ending == ".avi" else "libx264"
    whole = write_video(tmp_path / f"whole{container}", around, codec=codec)
    data = whole.read_bytes()
    broken = tmp_path / f"broken{container}"
    broken.write_bytes(data[: len(data) * 6 // 10])
    folder = tmp_path / "frames"
    folder.mkdir()
    (written,) = extract_frames([broken], folder)
    assert 10 < written.frames < 48 and len(written.names) > 2
    if ending != ".ts":  # whose length is that of what is there
        assert any(said.startswith("its end cannot be read") for said in written.said)
    for name in written.names:
        assert name in {path.name for path in folder.iterdir()}


def test_damage_in_the_middle_is_left_out(around: list[AnyArray], tmp_path: Path) -> None:
    whole = write_video(tmp_path / "whole.mp4", around)
    for seed in range(4):
        data = bytearray(whole.read_bytes())
        data[len(data) // 2 : len(data) // 2 + 6000] = np.random.default_rng(seed).bytes(6000)
        (tmp_path / "damaged.mp4").write_bytes(data)
        with opened_video(tmp_path / "damaged.mp4") as video:
            way = follow_camera(video)
            said = video.remarks()
        assert 15 < len(way.times_s) < 50
        assert any("damaged" in sentence or "dropped" in sentence for sentence in said)


def test_files_that_are_no_video_are_refused_in_one_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    import av

    monkeypatch.chdir(tmp_path)
    (tmp_path / "empty.mp4").write_bytes(b"")
    (tmp_path / "other.mp4").write_bytes(b"no video" * 1000)
    (tmp_path / "secret.jpg").write_bytes(cv2.imencode(".jpg", np.full((64, 64), 9, np.uint8))[1].tobytes())
    (tmp_path / "list.mp4").write_text("#EXTM3U\n#EXTINF:10,\nfile:secret.jpg\n#EXT-X-ENDLIST\n")
    (tmp_path / "concat.mkv").write_text("ffconcat version 1.0\nfile secret.jpg\n")
    whole = write_video(tmp_path / "whole.mp4", orbit(np.zeros(8)))
    (tmp_path / "half.mp4").write_bytes(whole.read_bytes()[:-900])  # its index is at the end
    with av.open(str(tmp_path / "sound.mp4"), "w") as container:
        stream = container.add_stream("aac", rate=8000)
        sound = av.AudioFrame.from_ndarray(np.zeros((1, 1024), np.float32), format="fltp", layout="mono")
        sound.sample_rate = 8000
        container.mux(stream.encode(sound))
        container.mux(stream.encode())
    for name, words in {
        "empty.mp4": "not a video that can be read",
        "other.mp4": "not a video that can be read",
        "list.mp4": "not a video that can be read",
        "concat.mkv": "not a video that can be read",
        "half.mp4": "not a video that can be read",
        "sound.mp4": "has no video, only audio",
    }.items():
        line = refused(capsys, "run", name)
        assert name in line and words in line
        assert not list(tmp_path.glob("out/*frames*"))


def test_one_frame_or_a_still_camera_says_what_to_do(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    write_video(tmp_path / "one.mp4", orbit(np.zeros(1)))
    write_video(tmp_path / "still.mp4", orbit(np.zeros(20)))
    write_video(tmp_path / "dark.mp4", [np.full((360, 480), 3, np.uint8)] * 8)
    for name, words in {
        "one": "one frame only",
        "still": "the camera does not move",
        "dark": "show nothing to follow",
    }.items():
        assert kolinear("run", f"{name}.mp4") == 2
        told = capsys.readouterr().err
        assert words in told and "at least 2 are needed" in told


def test_without_the_extra_one_line_names_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "a.MP4").write_bytes(b"")
    monkeypatch.setattr(video_files, "is_installed", lambda _: False)
    for words in (("run", tmp_path / "a.MP4"), ("init", tmp_path / "a.MP4"), ("run", tmp_path)):
        assert "kolinear[photographs]" in refused(capsys, *words)


def sizes(points: AnyArray) -> AnyArray:
    size = np.linalg.norm(points[:, None] - points, axis=2)
    return size / size.mean()


def assert_right(result: Path) -> None:
    """Assert that the shape of the coded points is that of the plates."""
    rows = {row["id"]: row for row in rows_of(result / "points.csv") if row["id"].isdigit()}
    found = np.array([[float(row[axis]) for axis in "XYZ"] for row in rows.values()])
    true = np.array([code_centres()[int(name)] for name in rows])
    assert len(rows) >= 18
    np.testing.assert_allclose(sizes(found), sizes(true), atol=2e-3)


def test_a_video_becomes_a_result(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """And is read once: a second run takes the frames that are there."""
    monkeypatch.chdir(tmp_path)
    frames = rendered(np.linspace(0, 5.0, 40))
    write_video(tmp_path / "Clip 1.mp4", frames, rotation=-90)
    assert kolinear("run", "Clip 1.mp4", "--frames", "12") == 0
    told = capsys.readouterr().err
    assert "Clip 1.mp4: 12 frames of 40" in told
    assert_right(Path("out/Clip_1"))
    survey = read_survey_file(Path("out/Clip_1.toml"))
    assert survey.name == "Clip 1" and len(survey.cameras) == 1 and survey.cameras[0].name == "clip-1"
    taken = {path: path.stat().st_mtime_ns for path in Path("out/Clip_1-frames").iterdir()}
    assert kolinear("run", "Clip 1.mp4") == 0 and kolinear("run", "out/Clip_1.toml") == 0
    assert {path: path.stat().st_mtime_ns for path in Path("out/Clip_1-frames").iterdir()} == taken
    capsys.readouterr()
    line = refused(capsys, "run", "Clip 1.mp4", "--frames", "9")
    assert "--frames 9 is for drafting a survey file" in line
    assert "is for videos" in refused(capsys, "run", "out/Clip_1-frames", "--frames", "9", "--out", "other/x")
    (tmp_path / "more").mkdir()
    write_video(tmp_path / "more" / "Clip 1.mp4", frames[:12])
    kolinear("run", "more/Clip 1.mp4")
    assert Path("out/more_Clip_1-frames", LIST).is_file(), "another video of this name"


def test_init_writes_frames_beside_the_survey_file(tmp_path: Path) -> None:
    write_video(tmp_path / "clip.mp4", orbit(np.linspace(0, 0.7, 20)))
    assert kolinear("init", tmp_path / "clip.mp4") == 0
    assert read_survey_file(tmp_path / "clip.toml").photographs == "clip-frames"
    assert 4 <= len(list((tmp_path / "clip-frames").glob("clip-*ms.jpg"))) <= 6
    assert kolinear("init", tmp_path / "clip.mp4", "--out", tmp_path / "b" / "own.toml", "--frames", 3) == 0
    assert len(list((tmp_path / "b" / "own-frames").glob("*.jpg"))) == 3


@pytest.mark.usefixtures("in_process")
def test_two_videos_of_a_folder_are_two_cameras(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    folder = tmp_path / "videos"
    folder.mkdir()
    frames = orbit(np.linspace(0, 1.2, 40))
    write_video(folder / "GX01.mp4", frames[:12])
    write_video(folder / "GX02.MP4", frames[15:])
    (folder / "notes.txt").write_text("some")
    assert kolinear("init", folder) == 0
    survey = read_survey_file(folder / "survey.toml")
    assert sorted(camera.name for camera in survey.cameras) == ["gx01", "gx02"] and not survey.rigs
    assert kolinear("batch", folder / "GX01.mp4", "--out", "out/all") in (0, 1)
    assert Path("out/all/GX01/report.html").is_file() and Path("out/all/GX01-frames").is_dir()
    capsys.readouterr()
    photographs = tmp_path / "photos"
    photographs.mkdir()
    for k, frame in enumerate(frames[::6]):
        cv2.imwrite(str(photographs / f"IMG_{k}.png"), frame)
    write_video(photographs / "IMG_0.mov", frames[:3])  # of a telephone, beside its photograph
    write_video(photographs / "walk.mp4", frames[:3])
    assert kolinear("init", photographs) == 0
    told = capsys.readouterr().err
    assert "left out: walk.mp4: a video beside photographs" in told and "IMG_0.mov" not in told


def test_a_picture_of_a_cover_is_no_video(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    import av

    with av.open(str(tmp_path / "music.mp4"), "w") as container:
        cover = container.add_stream("mjpeg", rate=1)
        cover.width, cover.height, cover.pix_fmt = 64, 64, "yuvj420p"
        cover.disposition = av.stream.Disposition.attached_pic
        picture = av.VideoFrame.from_ndarray(np.full((64, 64, 3), 90, np.uint8), format="rgb24")
        container.mux(cover.encode(picture))
        container.mux(cover.encode())
    assert "has no video, only a cover" in refused(capsys, "run", tmp_path / "music.mp4")


def test_both_decodings_of_a_video_are_announced(tmp_path: Path) -> None:
    class Counts(Silent):
        def __init__(self) -> None:
            self.stages: list[list[object]] = []

        def stage(self, name: str, total: int | None = None) -> None:
            self.stages.append([name, total, 0])

        def advance(self, step: str = "") -> None:
            self.stages[-1][2] = int(str(self.stages[-1][2])) + 1

    video = write_video(tmp_path / "clip.mp4", orbit(np.linspace(0, 0.5, 12), seed="announced"), rate=12)
    (tmp_path / "frames").mkdir()
    counts = Counts()
    (written,) = extract_frames([video], tmp_path / "frames", progress=counts)
    (decoded, _, frames), (writing, last, again) = counts.stages
    assert (decoded, writing) == ("frames", "writing") and frames == written.frames == 12
    assert last == again <= 12
