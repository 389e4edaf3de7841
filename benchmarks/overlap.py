"""Times the search of photographs that overlap, and counts the overlapping pairs that it finds.

    python -m benchmarks.overlap --photographs 100 200 400 800 1600 3200
    python -m benchmarks.overlap --photographs 100 400 --rivals all colmap

A wall is photographed in strips, 60 % along and 50 % across, in random order: half of it is textured, half is
façades with equal windows of four kinds. Photographs are tilted, of different exposure and sharpness, and
things of their own stand before a fifth of each. The features are those of SIFT, kept in --work. The truth is
the area that two photographs have in common, relative to the smaller one.

Rivals: "all" compares all pairs, "colmap" asks COLMAP's vocabulary tree, trained on the same features, for as
many photographs as are compared here. Printed are processor time, pairs per photograph, the share of the
pairs of several overlaps that are compared, and, where it is smaller, chosen; with several numbers of
photographs, also the exponent of the growth of time.
"""

from __future__ import annotations

import argparse
import time
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from tempfile import TemporaryDirectory
from unittest.mock import patch

import cv2
import numpy as np
from scipy.spatial import cKDTree

from adapters.colmap.adjuster import quiet
from sfm.matching.tracks import overlap
from sfm.matching.tracks.features import Features, sift_features
from sfm.matching.tracks.overlap import COMPARED, compare_photographs, overlapping_pairs
from sfm.model.conventions import AnyArray, FloatArray, IntArray
from sfm.runtime.threads import own_threads

SIZE_PX = (640, 480)
STEP_PX = (256, 240)  # along a strip, and between strips
MARGIN_PX = 740  # of the wall around the middles of the photographs
NOISE = 2.5  # standard deviation of an intensity, of 256 levels
OCTAVES = 5
BLOCK_PX = 1600  # side of a façade or a textured square
WINDOW_PX, PITCH_PX = (110, 170), (170, 230)
KINDS = 4  # of windows
THINGS = 5  # before the wall in each photograph
MAX_FEATURES = 1000
WORDS, POINTS_A_WORD = 8192, 16  # of COLMAP's vocabulary
SEED = 20
BINS = (0.03, 0.1, 0.2, 0.35, 0.5, 1.0)  # limits of the overlaps


@dataclass(frozen=True)
class Flight:
    """Features of photographs of a wall."""

    features: list[Features]
    corners: FloatArray  # of each photograph on the wall, px, (m, 4, 2)


def main() -> None:
    """Run the command line."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0] if __doc__ else "")
    parser.add_argument("--photographs", type=int, nargs="+", default=[100, 200, 400])
    parser.add_argument("--rivals", nargs="*", default=[], choices=["all", "colmap"])
    parser.add_argument("--work", type=Path, default=Path("build/overlap"))
    arguments = parser.parse_args()
    limits = [f"{low:.2f}-{high:.2f}" for low, high in pairwise(BINS)]
    print(f"{'photographs':<12}{'method':<18}{'cpu s':>8}{'pairs':>8}  {'  '.join(limits)}")
    seconds = []
    with own_threads(1):
        for m in arguments.photographs:
            flight = take_photographs(m, arguments.work / f"{m}.npz")
            pairs, share = common_areas(flight.corners)
            begun = time.process_time()
            compared = compare_photographs(flight.features)
            chosen = overlapping_pairs(compared)
            seconds.append(time.process_time() - begun)
            _print(m, "compared", seconds[-1], compared.pairs, pairs, share)
            _print(m, "chosen", seconds[-1], chosen, pairs, share)
            if "all" in arguments.rivals:
                begun = time.process_time()
                with patch.object(overlap, "COMPARED", m):
                    chosen = overlapping_pairs(compare_photographs(flight.features))
                _print(m, "chosen of all", time.process_time() - begun, chosen, pairs, share)
            if "colmap" in arguments.rivals:
                training, search, retrieved = ask_colmap(flight.features)
                _print(m, f"colmap +{training:.0f} s", search, retrieved, pairs, share)
    if len(seconds) > 1:
        power = np.polyfit(np.log(arguments.photographs), np.log(seconds), 1)[0]
        print(f"time grows as n^{power:.2f}")


def take_photographs(m: int, kept: Path) -> Flight:
    """Return the features of m photographs of a wall, in random order; they are kept in a file."""
    if not kept.is_file():
        columns = int(np.ceil(np.sqrt(m * SIZE_PX[1] / SIZE_PX[0])))
        rows = -(-m // columns)
        wall, features = _wall(columns, rows), []
        corners = _corners(columns, rows)[np.random.default_rng(SEED).permutation(columns * rows)[:m]]
        for index, quad in enumerate(corners):
            features.append(sift_features(_photograph(wall, quad, index), max_features=MAX_FEATURES))
        kept.parent.mkdir(parents=True, exist_ok=True)
        np.savez(
            kept,
            corners=corners,
            count=[len(of_photograph) for of_photograph in features],
            xy=np.concatenate([of_photograph.xy for of_photograph in features]),
            scale=np.concatenate([of_photograph.scale for of_photograph in features]),
            descriptor=np.concatenate([of_photograph.descriptor for of_photograph in features]),
        )
    with np.load(kept) as arrays:
        ends = np.cumsum(arrays["count"])[:-1]
        parts = [np.split(arrays[name], ends) for name in ("xy", "scale", "descriptor")]
        taken = [Features(xy, scale, np.zeros(len(xy)), d) for xy, scale, d in zip(*parts, strict=True)]
        return Flight(taken, arrays["corners"])


def common_areas(corners: FloatArray) -> tuple[IntArray, FloatArray]:
    """Return the pairs of photographs that overlap, (p, 2), and by how much of the smaller one, (p,)."""
    quads = corners.astype(np.float32)
    near = cKDTree(quads.mean(axis=1)).query_pairs(1.5 * SIZE_PX[0], output_type="ndarray")
    share = []
    for i, j in near.tolist():
        area = cv2.intersectConvexConvex(quads[i], quads[j])[0]
        share.append(area / min(cv2.contourArea(quads[i]), cv2.contourArea(quads[j])))
    return near, np.array(share)


def ask_colmap(features: list[Features]) -> tuple[float, float, IntArray]:
    """Return the processor times of training and search by COLMAP's vocabulary tree, s, and its pairs."""
    import pycolmap

    kind = pycolmap.FeatureExtractorType.SIFT
    of_bytes = [
        np.rint(512 * of_photograph.descriptor).clip(0, 255).astype(np.uint8) for of_photograph in features
    ]
    every = np.concatenate(of_bytes).astype(np.float32)
    words = min(WORDS, len(every) // POINTS_A_WORD)
    sample = np.random.default_rng(SEED).choice(len(every), words * POINTS_A_WORD, replace=False)
    building = pycolmap.VisualIndex.BuildOptions()
    building.num_visual_words, building.num_iterations, building.num_rounds = words, 10, 1
    asking = pycolmap.VocabTreePairingOptions()
    asking.num_images, building.num_threads, asking.num_threads = COMPARED, 1, 1
    with TemporaryDirectory() as folder, quiet(pycolmap):
        asking.vocab_tree_path = Path(folder) / "tree.bin"
        begun = time.process_time()
        tree = pycolmap.VisualIndex.create(every.shape[1], 64)
        tree.build(building, pycolmap.FeatureDescriptorsFloat(kind, every[sample]))
        trained = time.process_time()
        tree.write(asking.vocab_tree_path)
        database = pycolmap.Database.open(Path(folder) / "database.db")
        lens = database.write_camera(
            pycolmap.Camera(model="SIMPLE_PINHOLE", width=640, height=480, params=[600, 320, 240])
        )
        for index, of_photograph in enumerate(features):
            image = database.write_image(pycolmap.Image(name=f"{index:05d}.png", camera_id=lens))
            shape = np.tile([1.0, 0.0], (len(of_photograph), 1))
            database.write_keypoints(image, np.column_stack([of_photograph.xy, shape]).astype(np.float32))
            database.write_descriptors(image, pycolmap.FeatureDescriptors(kind, of_bytes[index]))
        begun_search = time.process_time()
        pairs = np.array(pycolmap.VocabTreePairGenerator(asking, database).all_pairs()) - 1
        searched = time.process_time()
        database.close()
    different = np.sort(pairs[pairs[:, 0] != pairs[:, 1]], axis=1)
    return trained - begun, searched - begun_search, np.unique(different, axis=0)


def _wall(columns: int, rows: int) -> AnyArray:
    """Return a wall of textured squares and of façades with equal windows, uint8."""
    rng = np.random.default_rng(SEED)
    width, height = (
        2 * MARGIN_PX + step * count for step, count in zip(STEP_PX, (columns, rows), strict=True)
    )
    grain = _grain(rng, width, height, 3)
    grain *= 28 / grain.std()
    grain += 110
    kinds = []
    for kind in range(KINDS):
        pane = 60 + 18 * _grain(rng, *WINDOW_PX, 6)
        right, bottom, bar = WINDOW_PX[0] - 4, WINDOW_PX[1] - 4, 60 + 8 * kind
        cv2.rectangle(pane, (3, 3), (right, bottom), 200, 5)
        cv2.line(pane, (WINDOW_PX[0] // 2, 3), (WINDOW_PX[0] // 2, bottom), 190, 3)
        cv2.line(pane, (3, bar), (right, bar), 190, 3)
        for x, y, radius, light in rng.integers((10, 10, 3, 20), (100, 160, 9, 240), (6, 4)).tolist():
            cv2.circle(pane, (x, y), radius, light, -1)
        kinds.append(pane)
    for top in range(0, height - BLOCK_PX, BLOCK_PX):
        for left in range(top // BLOCK_PX % 2 * BLOCK_PX, width - BLOCK_PX, 2 * BLOCK_PX):
            facade = grain[top : top + BLOCK_PX, left : left + BLOCK_PX]
            facade[:] = 150 + 0.35 * (facade - 110)
            pane = kinds[int(rng.integers(KINDS))]
            for y in range(40, BLOCK_PX - WINDOW_PX[1], PITCH_PX[1]):
                for x in range(40, BLOCK_PX - WINDOW_PX[0], PITCH_PX[0]):
                    light = rng.uniform(0.9, 1.1)
                    facade[y : y + WINDOW_PX[1], x : x + WINDOW_PX[0]] = light * pane
    return np.clip(grain, 0, 255).astype(np.uint8)


def _grain(rng: np.random.Generator, width: int, height: int, finest_px: int) -> AnyArray:
    """Return a texture of several octaves, float32, with a standard deviation of some units."""
    total = np.zeros((height, width), np.float32)
    for octave in range(OCTAVES):
        cell = finest_px * 2**octave
        cells = rng.standard_normal((height // cell + 3, width // cell + 3)).astype(np.float32)
        total += cv2.resize(cells, (width, height), interpolation=cv2.INTER_CUBIC) * 1.3**octave
    return total


def _corners(columns: int, rows: int) -> FloatArray:
    """Return the corners of the photographs on the wall, strip by strip, there and back, px, (m, 4, 2)."""
    rng = np.random.default_rng(SEED + 1)
    upright = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) * np.array(SIZE_PX) / 2
    corners = []
    for row in range(rows):
        for column in range(columns):
            middle = MARGIN_PX + np.array(STEP_PX) * (column + 0.5, row + 0.5) + rng.normal(0, 15, 2)
            angle = np.pi * (row % 2) + np.radians(rng.normal(0, 6))
            quad = upright * rng.uniform(0.88, 1.13) * (1 + rng.normal(0, 0.05, (4, 1)))
            turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
            corners.append(quad @ turn.T + middle)
    return np.array(corners)


def _photograph(wall: AnyArray, corners: FloatArray, index: int) -> AnyArray:
    """Return a photograph of a part of the wall, with things before it, blur, another exposure and noise."""
    rng = np.random.default_rng((SEED, index))
    width, height = SIZE_PX
    border = np.array([[0, 0], [width - 1, 0], [width - 1, height - 1], [0, height - 1]], np.float32)
    map_to_wall = cv2.getPerspectiveTransform(border, corners.astype(np.float32))
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    picture = cv2.warpPerspective(wall, map_to_wall, SIZE_PX, flags=flags).astype(np.float32)
    for _ in range(THINGS):
        wide, tall = rng.integers(60, 170, 2).tolist()
        x, y = int(rng.integers(0, width - wide)), int(rng.integers(0, height - tall))
        picture[y : y + tall, x : x + wide] = 120 + 18 * _grain(rng, wide, tall, 6)
    picture = cv2.GaussianBlur(picture, (0, 0), rng.uniform(0.5, 1.0)).clip(0, 255)
    picture = 255 * (picture / 255) ** rng.uniform(0.8, 1.25) * rng.uniform(0.85, 1.1)
    return np.rint((picture + rng.normal(0, NOISE, picture.shape)).clip(0, 255)).astype(np.uint8)


def _print(m: int, method: str, seconds: float, chosen: IntArray, pairs: IntArray, share: FloatArray) -> None:
    """Print the share of the overlapping pairs that are among others."""
    among = np.isin(np.sort(pairs, axis=1) @ [m, 1], chosen @ [m, 1])
    shares = [f"{among[(share >= low) & (share < high)].mean():9.3f}" for low, high in pairwise(BINS)]
    print(f"{m:<12}{method:<18}{seconds:8.2f}{len(chosen) / m:8.1f}  {'  '.join(shares)}", flush=True)


if __name__ == "__main__":
    main()
