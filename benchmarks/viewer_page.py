"""Times a page of 1,000 photographs, 20,000 points and 300,000 rays in Chromium with software rendering.

    python -m benchmarks.viewer_page [--photographs M] [--points N] [--rays R] [--keep FILE.html]

The following is printed: time to write the page, its size, time until the scene appears, frames per second
while it rotates, and the fraction of points drawn meanwhile. The time until the scene appears is wall time
and CPU time of all processes of the browser, which other programs disturb less. The frame rate is measured
again with nothing drawn, which shows the share of the browser itself. Both ways of software rendering are
timed: of the graphics library alone, without a graphics card, and of the whole browser.
"""

from __future__ import annotations

import argparse
import os
import shutil
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np
import psutil
from playwright.sync_api import sync_playwright
from scipy.spatial import cKDTree

from sfm.model.camera import camera_from_values
from sfm.model.estimate import Estimate
from sfm.model.network import ImagePoints, Network
from sfm.model.solution import Solution
from sfm.report.view_page import write_view
from sfm.report.viewer.embedded import scene_of_stored

FRAMES = 60
WARM_UP = 20  # frames in which the scene finds its frame rate
WAIT_MS = 120_000
WAYS = (
    ("--use-angle=swiftshader", "--enable-unsafe-swiftshader"),
    ("--disable-gpu", "--enable-unsafe-swiftshader"),
)
TURN = """(frames) => new Promise((done) => {
  const { scene } = document.getElementById('explore').viewer
  let k = 0
  const begun = performance.now()
  const step = () => {
    scene.turn(0.02, 0)
    if (++k < frames) requestAnimationFrame(step)
    else done(performance.now() - begun)
  }
  requestAnimationFrame(step)
})"""


def flight(photographs: int, points: int, rays: int) -> Solution:
    """Return a solution of photographs in rows above hilly ground, with standard deviations."""
    rng = np.random.default_rng(1)
    camera = camera_from_values("camera", "brown", (6000, 4000), (0.004, 0.004), c_mm=24.0)
    columns = round(np.sqrt(1.6 * photographs))
    place = np.arange(photographs)
    X0 = np.column_stack(
        [25.0 * (place % columns), 25.0 * (place // columns), 80 + rng.normal(0, 1, photographs)]
    )
    size = X0[:, :2].max(axis=0)
    xyz = np.column_stack([rng.uniform(0, size, (points, 2)), rng.normal(0, 4, points)])
    each = rays // points
    image = cKDTree(X0[:, :2]).query(xyz[:, :2], k=each)[1].ravel().astype(np.int64)
    point = np.repeat(np.arange(points), each)
    d = xyz[point] - X0[image]
    xy = np.column_stack([2999.5 - 6000 * d[:, 0] / d[:, 2], 1999.5 + 6000 * d[:, 1] / d[:, 2]])
    seen = ImagePoints(image, point, xy + rng.normal(0, 0.3, xy.shape), np.tile(np.eye(2), (len(xy), 1, 1)))
    names = tuple(f"IMG_{i:04d}.JPG" for i in range(photographs)), tuple(f"P{j}" for j in range(points))
    network = Network(names[0], np.zeros(photographs, np.int64), names[1], seen)
    sigma = rng.lognormal(np.log(2e-3), 0.4, points)
    covariance = np.eye(3) * (sigma[:, None, None] * np.array([1.0, 1.0, 2.0])) ** 2
    rotation = np.tile(np.eye(3), (photographs, 1, 1))
    return Solution("flight", network, Estimate((camera,), X0, rotation, xyz), covariance, unit="m")


def cpu_seconds() -> float:
    """Return the CPU time of all processes that this process has started, s."""
    total = 0.0
    for process in psutil.Process().children(recursive=True):
        try:
            times = process.cpu_times()
        except psutil.NoSuchProcess:
            continue
        total += times.user + times.system
    return total


HIDE = """() => {
  const { scene } = document.getElementById('explore').viewer
  for (const part of scene.world.children) part.visible = false
}"""


def time_page(page_file: Path, browser: Any) -> None:
    """Print the time that a page takes to open, and its frame rate while it rotates."""
    page = browser.new_page(viewport={"width": 1400, "height": 1000})
    begun, cpu = time.perf_counter(), cpu_seconds()
    page.goto(page_file.as_uri())
    page.wait_for_selector("#explore[data-ready]", timeout=WAIT_MS)
    print(f"  open: {time.perf_counter() - begun:.2f} s, CPU {cpu_seconds() - cpu:.2f} s")
    page.evaluate(TURN, WARM_UP)
    part = page.evaluate("document.getElementById('explore').viewer.scene.part ?? 1")
    print(f"  turning: {_pace(page)}, 1 point in {part} drawn")
    page.evaluate(HIDE)
    print(f"  nothing drawn: {_pace(page)}")
    page.close()


def _pace(page: Any) -> str:
    cpu = cpu_seconds()
    milliseconds = page.evaluate(TURN, FRAMES)
    used = (cpu_seconds() - cpu) / FRAMES
    return f"{1000 * FRAMES / milliseconds:.1f} frames per second, CPU {1000 * used:.0f} ms per frame"


def main() -> None:
    """Write the page and time it."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--photographs", type=int, default=1000)
    parser.add_argument("--points", type=int, default=20_000)
    parser.add_argument("--rays", type=int, default=300_000)
    parser.add_argument("--keep", type=Path)
    asked = parser.parse_args()
    print(f"load of the machine: {os.getloadavg()[0]:.1f} on {os.cpu_count()} cores")
    with tempfile.TemporaryDirectory() as folder:
        begun = time.perf_counter()
        scene = scene_of_stored(flight(asked.photographs, asked.points, asked.rays))
        file = write_view(scene, asked.keep or Path(folder) / "page.html", source="synthetic", paths={})
        print(
            f"{len(scene.photographs)} photographs, {len(scene.points)} points, {len(scene.rays)} rays: "
            f"written in {time.perf_counter() - begun:.1f} s, {file.stat().st_size / 1e6:.1f} MB"
        )
        with sync_playwright() as playwright:
            for way in WAYS:
                print(f"chromium {way[0]}")
                path = shutil.which("chromium")
                browser = playwright.chromium.launch(executable_path=path, args=["--no-sandbox", *way])
                for _ in range(2):
                    time_page(file.resolve(), browser)
                browser.close()


if __name__ == "__main__":
    main()
