"""Targets against the Cramer-Rao bound of a blurred ellipse, and against what people use now."""

from __future__ import annotations

import subprocess
import sys
import time
from pathlib import Path

import cv2
import numpy as np
import pytest

from sfm.model.conventions import AnyArray, FloatArray
from sfm.targets.detect import find_targets
from tests.places import ROOT
from tests.synthetic import seed_of

SUPER, NOISE, CONTRAST = 4, 2.0, 150.0


def coverage(x0: float, y0: float, a: float, b: float, angle: float, blur: float, size: int) -> AnyArray:
    """Return the area sampled picture of a blurred ellipse in a window of size x size px."""
    y, x = (np.mgrid[: size * SUPER, : size * SUPER] + 0.5) / SUPER - 0.5
    c, s = np.cos(angle), np.sin(angle)
    u, v = (c * (x - x0) + s * (y - y0)) / a, (c * (y - y0) - s * (x - x0)) / b
    rho = np.hypot(u, v) + 1e-9
    distance = rho * (rho - 1) / (np.hypot(u / a, v / b) + 1e-9)
    soft = cv2.GaussianBlur(np.clip(0.5 - distance * SUPER, 0, 1).astype(np.float32), (0, 0), blur * SUPER)
    return cv2.resize(soft, (size, size), interpolation=cv2.INTER_AREA)


def photograph(
    count: tuple[int, int], pitch: float, sign: int, shading: float, seed: int
) -> tuple[AnyArray, FloatArray, FloatArray]:
    """Return a photograph of targets on a grid, their centres, and the bound of the variance of a coordinate.

    The position is uncorrelated with all that is symmetric about the centre (shape, levels, blur), so its
    bound follows from its own two derivatives; the gain of a shaded target is taken as known.
    """
    rng = np.random.default_rng(seed)
    columns, rows = count
    background = 30.0 if sign > 0 else 200.0
    image = np.full((int(rows * pitch), int(columns * pitch)), background, np.float32)
    truth, bound = [], []
    for k in range(columns * rows):
        xy = pitch * (np.array([k % columns, k // columns]) + 0.5) + rng.uniform(-10, 10, 2)
        a, b = np.sort(rng.uniform(1.8, 12, 2))[::-1]
        angle, blur, toward = rng.uniform(-1.5, 1.5), rng.uniform(0.7, 1.0), rng.uniform(0, 2 * np.pi)
        size = 2 * int(a + 22) + 1
        left, top = (xy - size // 2).astype(int)
        x, y = xy - (left, top)
        clean = background + sign * CONTRAST * coverage(x, y, a, b, angle, blur, size)
        h = 0.05
        dx = coverage(x + h, y, a, b, angle, blur, size) - coverage(x - h, y, a, b, angle, blur, size)
        dy = coverage(x, y + h, a, b, angle, blur, size) - coverage(x, y - h, a, b, angle, blur, size)
        J = CONTRAST / (2 * h) * np.stack([dx.ravel(), dy.ravel()]).astype(float)
        bound.append(np.trace(np.linalg.inv(J @ J.T)) / 2 * (NOISE**2 + 1 / 12))
        truth.append(xy)
        j, i = np.meshgrid(np.arange(size) - x, np.arange(size) - y)
        fade = np.clip((a + 22 - np.hypot(j, i)) / 12, 0, 1)  # no step at the end of the window
        gain = 1 + shading * fade * (j * np.cos(toward) + i * np.sin(toward)) / (2 * a)
        image[top : top + size, left : left + size] = clean * gain
    image += NOISE * rng.standard_normal(image.shape, dtype=np.float32)
    return np.rint(image).clip(0, 255).astype(np.uint8), np.array(truth), np.array(bound)


def measured(image: AnyArray, truth: FloatArray, sign: int) -> tuple[FloatArray, float, int]:
    """Return the errors, the mean normalised squared error and the number of targets that are not there."""
    found = find_targets(image, polarity="bright" if sign > 0 else "dark", min_diameter_px=3)
    distance = np.hypot(*(found.xy[:, None] - truth[None]).transpose(2, 0, 1))
    at = distance.argmin(axis=0)
    assert distance.min(axis=0).max() < 0.5, "a target was not found"
    error = found.xy[at] - truth
    squared = np.einsum("ki,kij,kj->k", error, np.linalg.inv(found.covariance[at]), error) / 2
    return error, float(squared.mean()), len(found) - len(truth)


@pytest.mark.parametrize(("diameter", "blur", "noise"), [(5.0, 0.8, 2.0), (5.0, 1.2, 5.0)])
def test_dots_of_five_pixels_are_at_the_bound(diameter: float, blur: float, noise: float) -> None:
    """Before: 21 % of the softer ones were rejected as blurred. 200 coordinates give the ratio to 5 %."""
    rng, pitch, size = seed_of("five"), 27, 23
    image, truth, bound = np.full((10 * pitch, 10 * pitch), 200.0, np.float32), [], []
    for k in range(100):
        middle = pitch * (np.array(divmod(k, 10))[::-1] + 0.5) - 0.5
        left, top = middle.astype(int) - size // 2
        x, y = size // 2 + rng.uniform(-1, 1, 2)

        def at(dx: float, dy: float, x: float = x, y: float = y) -> AnyArray:
            return coverage(x + dx, y + dy, diameter / 2, diameter / 2, 0.0, blur, size)

        h = 0.05
        J = CONTRAST / (2 * h) * np.stack([at(h, 0) - at(-h, 0), at(0, h) - at(0, -h)]).reshape(2, -1)
        bound.append(np.trace(np.linalg.inv(J.astype(float) @ J.T.astype(float))) / 2 * (noise**2 + 1 / 12))
        image[top : top + size, left : left + size] -= CONTRAST * at(0, 0)
        truth.append((left + x, top + y))
    image += noise * rng.standard_normal(image.shape, dtype=np.float32)
    error, squared, extra = measured(np.rint(image).clip(0, 255).astype(np.uint8), np.array(truth), -1)
    assert extra == 0
    assert np.sqrt((error**2).mean() / np.mean(bound)) < 1.05 + 2 * 0.05
    assert squared == pytest.approx(1.0, abs=3 * 0.1)


# Limits for the root mean square error over the bound: 1.05 flat, 1.1 dark and 1.6 bright if shaded by 20 %.
CASES = [(-1, 0.0, 1.05), (1, 0.0, 1.05), (-1, 0.2, 1.1), (1, 0.2, 1.6)]


@pytest.mark.sweep(1, 2)
@pytest.mark.parametrize(("sign", "shading", "limit"), CASES)
def test_few_targets_are_at_the_bound(sign: int, shading: float, limit: float) -> None:
    image, truth, bound = photograph((10, 8), 90, sign, shading, 1)
    error, squared, extra = measured(image, truth, sign)
    ratio = np.sqrt(((error**2).mean(axis=1) / bound).mean())
    # 160 coordinates: the ratio is known to 6 %, the mean square to 11 %; thin targets have longer tails
    assert ratio < limit + 2 * 0.06
    assert squared == pytest.approx(1.0, abs=3 * 0.11)
    assert extra == 0


@pytest.mark.slow
@pytest.mark.parametrize(("sign", "shading", "limit"), CASES)
def test_24_megapixels_at_the_bound(sign: int, shading: float, limit: float) -> None:
    ratios, squares = [], []
    for seed in range(4):
        image, truth, bound = photograph((30, 20), 200, sign, shading, seed)
        error, squared, extra = measured(image, truth, sign)
        ratios.append(((error**2).mean(axis=1) / bound).mean())
        squares.append(squared)
        assert extra == 0
    print(sign, shading, np.sqrt(np.mean(ratios)), np.mean(squares))
    assert np.sqrt(np.mean(ratios)) < limit
    assert np.mean(squares) == pytest.approx(1.0, abs=0.1)


@pytest.mark.slow
def test_faster_and_better_than_the_simple_blob_detector() -> None:
    image, truth, _ = photograph((30, 20), 200, 1, 0.0, 1)
    settings = cv2.SimpleBlobDetector_Params()
    settings.blobColor = 255
    detector = cv2.SimpleBlobDetector_create(settings)
    error, _, _ = measured(image, truth, 1)
    seconds = {"kolinear": [], "simple blob": []}
    threads = cv2.getNumThreads()
    cv2.setNumThreads(1)  # both work in one thread, and other programs do not count
    for _ in range(5):
        start = time.process_time()
        find_targets(image, polarity="bright", min_diameter_px=3)
        between = time.process_time()
        blobs = detector.detect(image)
        seconds["kolinear"].append(between - start)
        seconds["simple blob"].append(time.process_time() - between)
    cv2.setNumThreads(threads)
    xy = np.array([b.pt for b in blobs])
    distance = np.hypot(*(xy[:, None] - truth[None]).transpose(2, 0, 1))
    seen = distance.min(axis=0) < 2
    theirs = (xy[distance.argmin(axis=0)] - truth)[seen]
    print({k: min(v) for k, v in seconds.items()}, np.sqrt((theirs**2).mean()), np.sqrt((error**2).mean()))
    assert min(seconds["kolinear"]) < min(seconds["simple blob"]) / 2.5
    assert np.sqrt((error[seen] ** 2).mean()) < np.sqrt((theirs**2).mean()) / 3


MEASURE = """
import re, sys
from pathlib import Path
from sfm.targets.detect import find_targets
from sfm.photographs.reading import read_photograph
found = find_targets(read_photograph(Path(sys.argv[1])), polarity="bright", min_diameter_px=3)
# The peak that getrusage tells begins with that of the process which started this one.
print(len(found), int(re.search(r"VmHWM:\\s+(\\d+)", Path("/proc/self/status").read_text())[1]) // 1024)
"""


@pytest.mark.slow
def test_24_megapixels_with_600_targets_stay_under_500_mib(tmp_path: Path) -> None:
    image, truth, _ = photograph((30, 20), 200, 1, 0.0, 1)
    path = tmp_path / "targets.png"
    cv2.imwrite(str(path), image, [cv2.IMWRITE_PNG_COMPRESSION, 1])
    root = ROOT
    run = subprocess.run(
        [sys.executable, "-c", MEASURE, str(path)], cwd=root, capture_output=True, text=True, check=True
    )
    count, mib = (int(word) for word in run.stdout.split())
    print(f"{image.size / 1e6:.0f} megapixels, {count} targets: {mib} MiB at most")
    assert count == len(truth) == 600
    assert mib < 500
