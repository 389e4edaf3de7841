"""Videos of cameras that move together: the difference of their clocks, and frames of one moment."""

from __future__ import annotations

import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from sfm.model.conventions import FloatArray
from sfm.products.drafting.video_clocks import clock_difference
from sfm.products.drafting.video_frames import SAME_PLACE_RAD, Way, choose_of_all, extract_frames
from tests.synthetic import seed_of
from tests.videos import orbit, write_video

AHEAD_S = -1.37


def speeds(rng: np.random.Generator, length_s: float) -> tuple[FloatArray, FloatArray]:
    """Return the speed of a hand: moves of different length and speed, with rests between them."""
    fine = np.arange(0, length_s, 0.01)
    speed, at = np.zeros(len(fine)), float(rng.uniform(0.3, 1.5))
    while at < length_s:
        last = at + rng.uniform(0.4, 2.5)
        speed[(fine >= at) & (fine < last)] = rng.uniform(0.1, 0.8)
        at = last + rng.uniform(0.2, 1.5)
    return fine, np.convolve(speed, np.ones(25) / 25, "same")


def seen(
    motion: tuple[FloatArray, FloatArray], times: FloatArray, ahead_s: float, rng: np.random.Generator
) -> tuple[FloatArray, FloatArray]:
    """Return the apparent motion of a camera: another scale, and noise, at frames of its own clock."""
    shown = rng.uniform(0.5, 2.0) * np.interp(times - ahead_s, *motion)
    return times, np.abs(shown * rng.uniform(0.7, 1.3, len(times)) + 0.02 * rng.standard_normal(len(times)))


@pytest.mark.parametrize("rates", [(25, 25), (12, 15), (30, 24)])
def test_the_difference_of_clocks_is_found_to_a_part_of_a_frame(rates: tuple[int, int]) -> None:
    errors = []
    for number in range(20):
        rng = seed_of(f"rig of videos {number}")
        motion = speeds(rng, 25.0)
        a = seen(motion, np.arange(0, 18, 1 / rates[0]), 0.0, rng)
        b = seen(motion, np.arange(0, 17, 1 / rates[1]), AHEAD_S, rng)
        clock = clock_difference(a, b)
        assert clock is not None and clock.correlation > 0.7
        errors.append((clock.ahead_s - AHEAD_S) / clock.sigma_s)
        back = clock_difference(b, a)
        assert back is not None and back.ahead_s == pytest.approx(-clock.ahead_s, abs=clock.sigma_s)
    assert np.sqrt(np.square(errors).mean()) < 2


def test_cameras_that_are_carried_one_by_one_have_none() -> None:
    found = 0
    for number in range(100):
        rng = seed_of(f"videos of two persons {number}")
        a, b = (seen(speeds(rng, 30.0), np.arange(0, 20, 1 / 15), 0.0, rng) for _ in range(2))
        found += clock_difference(a, b) is not None
    assert found <= 1
    rng = seed_of("even")
    even = np.arange(0, 10, 0.04), 0.3 + 0.01 * rng.standard_normal(250)
    assert clock_difference(even, (even[0], 0.3 + 0.01 * rng.standard_normal(250))) is None
    still = np.arange(0, 10, 0.04), np.zeros(250)
    assert clock_difference(still, even) is None and clock_difference(still, still) is None
    short = np.arange(3) / 25, np.array([np.nan, 0.1, 0.3])
    assert clock_difference(short, even) is None


def way_of(motion: tuple[FloatArray, FloatArray], times: FloatArray, ahead_s: float) -> Way:
    speed = np.interp(times - ahead_s, *motion)
    return Way(times, np.cumsum(speed) * (times[1] - times[0]), 1 / (1 + speed), speed)


def test_frames_are_of_one_moment_where_the_cameras_stand_still() -> None:
    places = np.arange(0, 40, 0.01)
    speed = np.where(places % 2.0 < 0.4, 0.5, 0.0)  # a fifth of a radian, then a rest
    motion = places, np.convolve(speed, np.ones(9) / 9, "same")
    alone = way_of(motion, np.arange(0, 30, 1 / 25), 0.0)
    other = way_of(motion, np.arange(0, 25, 1 / 30), AHEAD_S)
    first, second = choose_of_all([alone, other])
    assert first.reference is None and second.reference == 0
    assert second.ahead_s == pytest.approx(AHEAD_S, abs=0.01)
    shared = np.isin(second.moments_s, first.moments_s)
    assert shared.sum() == second.shared > 0.8 * len(second.frames) > 8
    moving = np.interp(second.moments_s, *motion)
    assert moving[shared].max() * 0.004 < SAME_PLACE_RAD
    at = other.times_s[second.frames] - second.ahead_s
    assert np.abs(at - second.moments_s).max() < 1 / 25
    assert len(choose_of_all([alone, other], 7)[0].frames) == 7
    lone = choose_of_all([alone])[0]
    assert lone.reference is None and np.array_equal(lone.moments_s, alone.times_s[lone.frames])


def test_videos_of_a_rig_have_frames_of_the_same_names(tmp_path: Path) -> None:
    at = np.arange(0, 16, 1 / 12)
    turns = 0.22 * np.floor(at / 2) + 0.22 * np.clip((at % 2) / 0.5, 0, 1)
    left = write_video(tmp_path / "left.mp4", orbit(turns, seed="left"), rate=12)
    right = write_video(tmp_path / "right.mp4", orbit(turns[14:] + 0.4, seed="right"), rate=12)
    (tmp_path / "frames").mkdir()
    first, second = extract_frames([left, right], tmp_path / "frames")
    assert first.said == ()
    (said,) = second.said
    assert "moves together with left.mp4 and begins 1.1" in said and " s later: " in said
    moments = [{name.split("-")[1] for name in written.names} for written in (first, second)]
    assert len(moments[0] & moments[1]) >= 5
    assert f"{len(moments[0] & moments[1])} of {len(second.names)} frames show a moment of that" in said


@pytest.mark.parametrize("rate", [25.0, 1000 / 37])
def test_frames_that_are_not_of_one_moment_have_other_names(rate: float) -> None:
    rng = seed_of("moving on")
    motion = speeds(rng, 30.0)[0], 0.2 + speeds(rng, 30.0)[1]  # never still
    alone, other = (way_of(motion, np.arange(0, 25, 1 / rate), 0.0) for _ in range(2))
    first, second = choose_of_all([alone, other])
    assert second.reference == 0 and second.shared == 0 and len(second.frames) > 8
    names = [set(np.round(1000 * chosen.moments_s).tolist()) for chosen in (first, second)]
    assert not names[0] & names[1] and len(names[1]) == len(second.frames)


def test_what_only_one_of_two_videos_shows_gives_frames_too() -> None:
    motion = speeds(seed_of("long and short"), 60.0)
    short = way_of(motion, np.arange(20, 35, 1 / 25), 0.0)
    long = way_of(motion, np.arange(0, 60, 1 / 25), 0.0)
    _, second = choose_of_all([short, long])
    assert second.reference == 0
    at = long.times_s[second.frames]
    assert at.min() < 3 and at.max() > 55 and len(at) == len(set(at))
    alone = choose_of_all([long])[0]
    assert np.diff(long.way_rad[second.frames]).max() < 2 * np.diff(long.way_rad[alone.frames]).max()
    assert all(len(chosen.frames) == 1 for chosen in choose_of_all([long, short], 1))


@pytest.mark.parametrize(("begin", "end"), [(20, 35), (0, 40), (25, 60)])
@pytest.mark.parametrize("count", [1, 2, 12])
def test_a_stated_number_of_frames_is_spread_over_all_of_a_video(begin: int, end: int, count: int) -> None:
    motion = speeds(seed_of("long and short"), 60.0)
    short = way_of(motion, np.arange(begin, end, 1 / 25), 0.0)
    long = way_of(motion, np.arange(0, 60, 1 / 25), 0.0)
    first, second = choose_of_all([short, long], count)
    assert second.reference == 0
    assert len(first.frames) == len(second.frames) == count == len(set(second.frames.tolist()))
    gaps = np.diff([0.0, *long.way_rad[second.frames], long.way_rad[-1]])
    assert gaps.max() < 3.1 * long.way_rad[-1] / max(count, 2)  # the largest part without a frame


def test_videos_of_one_length_that_begin_apart_share_what_both_show() -> None:
    motion = speeds(seed_of("apart"), 60.0)
    ways = [way_of(motion, np.arange(begin, begin + 40, 1 / 25), 0.0) for begin in (0, 20)]
    first, second = choose_of_all(ways, 16)
    at = ways[1].times_s[second.frames]
    assert len(first.frames) == len(at) == 16 and at.min() < 25 and at.max() > 55
    assert 5 <= (at > 40).sum() <= 11


@pytest.mark.filterwarnings("error")
def test_frames_without_any_structure_are_compared() -> None:
    motion = speeds(seed_of("black"), 30.0)
    way = way_of(motion, np.arange(0, 25, 1 / 25), 0.0)
    first, second = choose_of_all([replace(way, sharpness=np.zeros(len(way.times_s)))] * 2)
    assert second.reference == 0 and len(first.frames) > 4


def test_videos_without_usable_times_have_no_difference() -> None:
    one = np.zeros(1), np.array([np.nan])
    rng = seed_of("times")
    many = np.arange(0, 10, 0.04), rng.random(250)
    same = np.zeros(50), rng.random(50)
    jump = np.append(many[0][:-1], 1e9), many[1]
    for a in (one, same, jump):
        for b in (one, same, jump, many):
            assert clock_difference(a, b) is None and clock_difference(b, a) is None


def test_long_videos_are_compared_in_seconds() -> None:
    rng = seed_of("ten minutes")
    motion = speeds(rng, 650.0)
    a = seen(motion, np.arange(0, 600, 1 / 15), 0.0, rng)
    b = seen(motion, np.arange(0, 600, 1 / 15), AHEAD_S, rng)
    begun = time.perf_counter()
    clock = clock_difference(a, b)
    assert clock is not None and abs(clock.ahead_s - AHEAD_S) < 4 * clock.sigma_s
    assert time.perf_counter() - begun < 20  # the correlation times of every difference took minutes
