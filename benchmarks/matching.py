"""Times matching against cv2: LSM against a loop of findTransformECC, NCC against a loop of matchTemplate.

python -m benchmarks.matching            # 10,000 patches, 1,000 templates
python -m benchmarks.matching --quick    # a tenth of that
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable

import cv2
import numpy as np

from sfm.matching.correlation import match_ncc
from sfm.matching.lsm.two_photo import match_lsm
from sfm.model.conventions import FloatArray
from tests.textures import REACH, Pairs, affine_pairs, random_texture, with_noise

SIGMA = 2.0
TEXTURES = 500  # different patches, which are repeated with other noise
HALF = 10
ECC_STEPS, ECC_EPS = 50, 1e-4  # with tighter limits, ECC is slower and no more precise
REPEATS = 3  # the fastest run counts


def main() -> None:
    """Print times per patch, precision and ratios."""
    share = 0.1 if "--quick" in sys.argv else 1.0
    cv2.setNumThreads(1)
    compare_lsm(round(10_000 * share))
    compare_ncc(round(1000 * share))


def compare_lsm(patches: int) -> None:
    """Compare LSM with 6 + 2 parameters and ECC with 6 parameters on the same patches of 21 x 21 px."""
    pairs = affine_pairs(1, min(TEXTURES, patches))
    rounds = [
        (with_noise(pairs.left, SIGMA, 2 * i), with_noise(pairs.right, SIGMA, 2 * i + 1))
        for i in range(max(1, patches // len(pairs.centre)))
    ]
    count = len(rounds) * len(pairs.centre)
    ours: list[FloatArray] = []
    theirs: list[FloatArray] = []
    match_lsm(*rounds[0], pairs.centre[:2], pairs.centre[:2])  # compiled before the clock starts
    alone = _fastest(lambda: _all_lsm(rounds, pairs, ours, 1))
    both = _fastest(lambda: _all_lsm(rounds, pairs, ours, 2), clock=time.perf_counter)
    ecc = _fastest(lambda: _all_ecc(rounds, pairs, theirs))
    rms = [_rms(np.array(results[-len(rounds) :]), pairs) for results in (ours, theirs)]
    bound = SIGMA * np.sqrt(np.trace(pairs.bound, axis1=1, axis2=2).mean() / 2)
    print(f"LSM, {count} patches of 21 x 21 px, noise {SIGMA:g} of 256 in both photographs")
    print(f"  match_lsm, 1 thread    {alone / count * 1e6:7.1f} us a patch   RMS {rms[0]:.5f} px")
    print(f"  match_lsm, 2 threads   {both / count * 1e6:7.1f} us a patch, wall time")
    print(f"  cv2.findTransformECC   {ecc / count * 1e6:7.1f} us a patch   RMS {rms[1]:.5f} px")
    print(f"  Cramer-Rao bound                             RMS {bound:.5f} px")
    print(f"  faster {ecc / alone:.1f} times, one thread each")
    print(f"  RMS over the bound: {rms[0] / bound:.3f} (ours), {rms[1] / bound:.3f} (ECC)")


def compare_ncc(templates: int) -> None:
    """Compare correlation of 21 x 21 templates in 121 x 121 windows with a bare loop of matchTemplate."""
    y, x = np.mgrid[0:700, 0:700].astype(float)
    texture = random_texture(np.random.default_rng(1), 2.0)
    value = np.vstack([texture.value(x[rows], y[rows]) for rows in np.array_split(np.arange(700), 20)])
    left, right = (np.rint(with_noise(value, SIGMA, i)).clip(0, 255).astype(np.uint8) for i in (1, 2))
    at = np.random.default_rng(2).integers(70, 630, (templates, 2))
    match_ncc(left, right, at[:1], at[:1], template_px=21, search_px=121)

    def bare() -> None:
        for col, row in at.tolist():
            window, template = (
                right[row - 60 : row + 61, col - 60 : col + 61],
                left[row - 10 : row + 11, col - 10 : col + 11],
            )
            cv2.matchTemplate(window, template, cv2.TM_CCOEFF_NORMED)

    ours = _fastest(lambda: match_ncc(left, right, at, at, template_px=21, search_px=121))
    theirs = _fastest(bare)
    print(f"NCC, {templates} templates of 21 x 21 px in windows of 121 x 121 px")
    print(f"  match_ncc              {ours / templates * 1e6:7.1f} us a template, peak and precision")
    print(f"  cv2.matchTemplate      {theirs / templates * 1e6:7.1f} us a template, sums only")
    print(f"  ratio {ours / theirs:.2f}")


def _all_lsm(
    rounds: list[tuple[FloatArray, FloatArray]], pairs: Pairs, results: list[FloatArray], threads: int
) -> None:
    for left, right in rounds:
        results.append(match_lsm(left, right, pairs.centre, pairs.centre, threads=threads).xy)


def _all_ecc(rounds: list[tuple[FloatArray, FloatArray]], pairs: Pairs, results: list[FloatArray]) -> None:
    stop = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, ECC_STEPS, ECC_EPS)
    centres = pairs.centre.astype(int).tolist()
    for left, right in rounds:
        xy = np.full((len(centres), 2), np.nan)
        for k, (col, row) in enumerate(centres):
            template = left[row - HALF : row + HALF + 1, col - HALF : col + HALF + 1]
            window = right[row - REACH : row + REACH + 1, col - REACH : col + REACH + 1]
            warp = np.array([[1, 0, REACH - HALF], [0, 1, REACH - HALF]], dtype=np.float32)
            _, warp = cv2.findTransformECC(template, window, warp, cv2.MOTION_AFFINE, stop, None, 1)
            xy[k] = warp @ [HALF, HALF, 1.0] + [col - REACH, row - REACH]
        results.append(xy)


def _rms(matched: FloatArray, pairs: Pairs) -> float:
    return float(np.sqrt(np.nanmean((matched - pairs.centre - pairs.shift) ** 2)))


def _fastest(work: Callable[[], object], *, clock: Callable[[], float] = time.process_time) -> float:
    """Return the time of the fastest run, s, by processor time unless another clock is given."""
    best = np.inf
    for _ in range(REPEATS):
        begun = clock()
        work()
        best = min(best, clock() - begun)
    return best


if __name__ == "__main__":
    main()
