"""Every format into every other, also parts alone: what both hold arrives, else it is refused."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from adapters.formats.content import Content
from adapters.formats.registry import FORMATS, FileFormat, format_named, read_content, write_content
from sfm.cli.commands.convert import convert
from sfm.model.errors import KolinearError, OutputError
from sfm.model.reduced_network import reduce_network
from sfm.model.solution import Solution
from tests.adapters.formats.clouds import library
from tests.synthetic import make_network, seed_of

PARTS = ("whole", "poses", "cameras", "points")
PARTS_OF = {
    "whole": {"cameras", "exterior orientations", "object points", "image points"},
    "poses": {"cameras", "exterior orientations"},
    "cameras": {"cameras"},
    "points": {"object points"},
}
READ = tuple(form for form in FORMATS if (form.read or form.read_all) is not None and form.writable)
STRAIGHT = ("bal", "sba", "bundle-matlab", "bundle-csharp")  # which want --undistort


def part_of(part: str, rng: np.random.Generator) -> Content:
    """A survey with three photographs, or a part of it alone; every format can name uncoded points."""
    network, truth = make_network(rng, images=3, points=10, model="opencv", free=())
    network = replace(
        network, images=("a1.jpg", "a2.jpg", "a3.jpg"), points=tuple(f"u{j + 1}" for j in range(10))
    )
    (camera,) = truth.cameras
    plain = camera.with_parameters(np.where(camera.parts[2], 0.0, camera.parameters))
    truth = replace(truth, cameras=(plain,))
    images, points = part in ("whole", "poses"), part in ("whole", "points")
    every = np.ones(len(network.image_points), dtype=bool)
    m, n = len(network.images), len(network.points)
    network, truth = reduce_network(network, truth, np.full(m, images), np.full(n, points), every)
    if part == "points":
        truth = replace(truth, cameras=())
    return Content(Solution(part, network, truth))


def held(form: FileFormat, part: str) -> set[str]:
    """What a format holds of a part of a survey."""
    kinds = PARTS_OF[part] & form.keeps
    if form.needs and form.needs not in PARTS_OF[part]:
        return set()
    return kinds - {"cameras"} if form.of_photographs and part == "cameras" else kinds


def carried(source: Path, target: Path, form: FileFormat) -> None:
    convert(source, target, to_format=form.name, straighten=form.name in STRAIGHT)


def places(folder: Path) -> Iterator[Path]:
    k = 0
    while True:
        k += 1
        yield folder / f"{k}"


@pytest.mark.parametrize("form", [form.name for form in READ])
def test_parts_pass_from_every_format_to_this_one(form: str, tmp_path: Path) -> None:
    library(form)
    rng = seed_of(f"pairs {form}")
    to, paths = format_named(form), places(tmp_path)
    passed = 0
    for source in READ:
        if source.name in ("laz", "e57"):
            library(source.name)
        parts = ("whole",) * 3 * bool(to.needs) + PARTS
        part = parts[int(rng.integers(len(parts)))]
        first, second = next(paths), next(paths)
        try:
            write_content(first, "tables", part_of(part, rng))
        except OutputError as error:
            pytest.fail(f"tables, {part}: {error}")
        if not held(source, part):
            with pytest.raises(KolinearError):
                carried(first, second, source)
            continue
        carried(first, second, source)
        of_source = held(source, part)
        third = next(paths)
        no_poses = not of_source & {"exterior orientations", "object points"} and part != "cameras"
        alone = to.of_photographs and of_source == {"cameras"} and part == "cameras"
        in_parts = bool(to.needs) and of_source != PARTS_OF["whole"]
        if not of_source & to.keeps or alone or in_parts or (to.placed and no_poses):
            with pytest.raises(KolinearError) as refused:
                convert(second, third, from_format=source.name, to_format=form)
            assert "\n" not in str(refused.value) and not third.exists()
            continue
        try:
            convert(second, third, from_format=source.name, to_format=form, straighten=form in STRAIGHT)
        except OutputError as error:  # the others have a camera for each photograph
            assert form.startswith("bundle-") and "have one camera" in str(error)
            continue
        before, after = read_content(second, source.name).result, read_content(third, form).result
        shared = of_source & to.keeps
        if "exterior orientations" in shared:
            np.testing.assert_allclose(
                after.estimate.position, before.estimate.position, rtol=1e-8, atol=1e-9
            )
            np.testing.assert_allclose(after.estimate.rotation, before.estimate.rotation, atol=1e-9)
        if "object points" in shared:
            np.testing.assert_allclose(after.estimate.points, before.estimate.points, rtol=1e-8, atol=1e-6)
        if "image points" in shared and not (to.placed and "object points" not in of_source):
            assert len(after.network.image_points) == len(before.network.image_points)
        passed += 1
    assert passed >= 3
