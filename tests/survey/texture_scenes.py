"""Weak and wrong scenes of natural texture, rendered, and what a survey of their folder says of its result.

    python -m tests.survey.texture_scenes [FIRST] [END] [KIND ...]

Each kind is a thing that photographs of walls and streets do to a survey: motion along the optical axis, a
wall seen from the front, rotation without a base, periods, water, walkers, reflections, two objects in one
folder, pictures that are mirrored, blurred or zoomed, strips of low overlap. Numbers from FIRST to END choose
textures and stations. A result is wrong where its projection centres are WRONG standard deviations and
SHARE of their extent from the truth after a similarity, root mean square; it is believed unless it is bad.
"""

from __future__ import annotations

import sys
import tempfile
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import cv2
import numpy as np

from benchmarks.textured import covariance_on_centres
from sfm.judgement.survey_result import SurveyResult
from sfm.model.conventions import BoolArray, FloatArray
from sfm.model.errors import KolinearError
from sfm.model.remarks.remark import kinds_of
from sfm.model.similarity import fit_similarity
from sfm.pipeline import run_survey
from sfm.products.drafting.draft import draft_survey
from sfm.products.planning.stations import aim_camera
from sfm.survey.inputs.survey import read_survey
from tests.findings import findings_of
from tests.synthetic import seed_of
from tests.textures import natural_texture

SIZE_PX = (640, 480)
C_PX = 576.0
TEXTURE_PX = 1000  # side of the texture of a plane
NOISE = 1.5  # grey values
WRONG, SHARE = 5.0, 0.01
NUMBERS = 4  # of each kind
LEVELS = ("good", "fair", "bad", "none")


@dataclass(frozen=True)
class Plane:
    """A textured rectangle in space."""

    corner: FloatArray  # lower left, (3,)
    right: FloatArray  # its lower edge, (3,)
    up: FloatArray  # its left edge, (3,)
    texture: FloatArray  # grey values, (h, w)


@dataclass
class Scene:
    """Photographs to be taken: planes from back to front, and stations."""

    planes: list[Plane]
    position: FloatArray  # (m, 3)
    rotation: FloatArray  # (m, 3, 3)
    in_photograph: dict[int, list[Plane]] = field(default_factory=dict)  # planes of single ones, in place
    c: FloatArray | None = None  # px, (m,)
    finish: Callable[[int, FloatArray], FloatArray] = lambda i, grey: grey
    objects: FloatArray | None = None  # number of the object that each photograph shows, (m,); one if None


def wall(rng: np.random.Generator, centre: FloatArray, right: FloatArray, up: FloatArray) -> Plane:
    """Return a plane with natural texture."""
    texture = natural_texture(rng, (TEXTURE_PX, TEXTURE_PX))
    return Plane(
        np.asarray(centre) - (np.asarray(right) + up) / 2, np.asarray(right), np.asarray(up), texture
    )


def corner_of_walls(rng: np.random.Generator, x: float = 0.0) -> list[Plane]:
    """Return two walls that meet, and the ground before them: an object in space."""
    z = rng.uniform(-0.3, 0.3)
    return [
        wall(rng, np.array([x - 2.0, 1.5, z]), np.array([4.0, 0.0, 1.5]), np.array([0.0, 5.0, 0.0])),
        wall(rng, np.array([x + 2.0, 1.5, z]), np.array([4.0, 0.0, -1.2]), np.array([0.0, 5.0, 0.0])),
        wall(rng, np.array([x, -1.0, 2.5]), np.array([8.0, 0.0, 0.0]), np.array([0.0, 0.3, -5.0])),
    ]


def around(
    rng: np.random.Generator, count: int, *, distance: float = 5.5, width: float = 4.0, x: float = 0.0
) -> tuple[FloatArray, FloatArray]:
    """Return stations side by side that look at the middle of an object."""
    position = np.column_stack(
        [
            x + np.linspace(-width / 2, width / 2, count) + rng.uniform(-0.15, 0.15, count),
            0.6 + rng.uniform(-0.5, 0.5, count),
            distance + rng.uniform(-0.4, 0.4, count),
        ]
    )
    aim = np.column_stack([x + rng.uniform(-0.3, 0.3, count), rng.uniform(0.4, 0.9, count), np.zeros(count)])
    rotation = np.array([upright(a - p, rng.uniform(-0.1, 0.1)) for a, p in zip(aim, position, strict=True)])
    return position, rotation


def upright(direction: FloatArray, roll: float = 0.0) -> FloatArray:
    """Return the rotation of a camera that looks along a direction, Y up."""
    # from Y of the scene to Z of `aim_camera`
    turn = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
    return np.asarray(turn.T @ aim_camera(turn @ direction, roll))


def usual(rng: np.random.Generator) -> Scene:
    """An object in space from eight stations: what must be good."""
    return Scene(corner_of_walls(rng), *around(rng, 8))


def street(rng: np.random.Generator) -> Scene:
    """Motion along the optical axis between two rows of houses."""
    side, far = np.array([0.0, 0.0, -40.0]), np.array([0.0, 6.0, 0.0])
    planes = [
        wall(rng, np.array([0.0, 1.0, -42.0]), np.array([12.0, 0.0, 0.0]), np.array([0.0, 9.0, 0.0])),
        wall(rng, np.array([-5.0, 1.0, -20.0]), side, far),
        wall(rng, np.array([5.0, 1.0, -20.0]), -side, far),
        wall(rng, np.array([0.0, -1.7, -20.0]), np.array([10.0, 0.0, 0.0]), side),
    ]
    count = 8
    position = np.column_stack(
        [rng.uniform(-0.3, 0.3, count), rng.uniform(-0.1, 0.1, count), -1.2 * np.arange(count)]
    )
    directions = np.column_stack([rng.normal(0, 0.03, (count, 2)), -np.ones(count)])
    return Scene(planes, position, np.array([upright(one) for one in directions]))


def frontal_wall(rng: np.random.Generator) -> Scene:
    """A flat wall, the optical axes at right angles to it."""
    planes = [wall(rng, np.zeros(3), np.array([9.0, 0.0, 0.0]), np.array([0.0, 7.0, 0.0]))]
    position = np.column_stack([np.linspace(-1.5, 1.5, 7), rng.uniform(-0.2, 0.2, 7), np.full(7, 5.0)])
    return Scene(planes, position, np.array([upright(np.array([0.0, 0.0, -1.0]))] * 7))


def no_base(rng: np.random.Generator) -> Scene:
    """A camera that turns at one place."""
    angles = np.linspace(-0.35, 0.35, 8)
    directions = np.column_stack([np.sin(angles), rng.normal(0, 0.05, 8), -np.cos(angles)])
    position = np.array([0.0, 0.6, 5.5]) + rng.normal(0, 1e-3, (8, 3))
    return Scene(corner_of_walls(rng), position, np.array([upright(one) for one in directions]))


def repeated(rng: np.random.Generator) -> Scene:
    """A façade of equal windows, and little else."""
    position, rotation = around(rng, 8)
    planes = corner_of_walls(rng)
    period = 125
    for one in planes[:2]:
        tile = natural_texture(rng, (period, period))
        copies = np.tile(tile, (TEXTURE_PX // period, TEXTURE_PX // period))
        one.texture[:] = copies + 0.04 * (one.texture - 128)
    planes[2].texture[:] = 128 + 0.1 * (planes[2].texture - 128)
    return Scene(planes, position, rotation)


def water(rng: np.random.Generator) -> Scene:
    """A shore whose foreground is another one in each photograph."""
    scene = usual(rng)
    back = scene.planes[:2]
    for i in range(len(scene.position)):
        sea = wall(rng, np.array([0.0, 0.6, 2.5]), np.array([8.0, 0.0, 0.0]), np.array([0.0, 0.6, -5.0]))
        scene.in_photograph[i] = [*back, sea]
    return scene


def walkers(rng: np.random.Generator) -> Scene:
    """People before the object who stay for a few photographs, and move together."""
    scene = usual(rng)
    crowd = [
        wall(rng, np.array([x, 0.4, 2.2]), np.array([0.9, 0.0, 0.1]), np.array([0.0, 1.9, 0.0]))
        for x in (-1.4, -0.2, 1.1)
    ]
    for i in range(len(scene.position)):
        walked = np.array([0.12 * i, 0.0, 0.02 * i])
        now = [Plane(one.corner + walked, one.right, one.up, one.texture) for one in crowd]
        scene.in_photograph[i] = [*scene.planes, *now]
    return scene


def reflections(rng: np.random.Generator) -> Scene:
    """A pane that mirrors another object onto the one behind it."""
    scene = usual(rng)
    other = Scene(corner_of_walls(rng), *around(rng, 8))
    mirrored = [_photograph(other, i)[:, ::-1] for i in range(8)]
    scene.finish = lambda i, grey: 0.6 * grey + 0.4 * mirrored[i]
    return scene


def two_objects(rng: np.random.Generator) -> Scene:
    """Photographs of two objects in one folder."""
    first, second = around(rng, 5), around(rng, 4, x=60.0)
    planes = [*corner_of_walls(rng), *corner_of_walls(rng, 60.0)]
    position, rotation = (np.concatenate(both) for both in zip(first, second, strict=True))
    scene = Scene(planes, position, rotation)
    scene.objects = np.repeat([0, 1], [5, 4])
    return scene


def mirrored(rng: np.random.Generator) -> Scene:
    """Two of nine photographs turned over, as scanned film."""
    scene = Scene(corner_of_walls(rng), *around(rng, 9))
    scene.finish = lambda i, grey: grey[:, ::-1] if i in (2, 6) else grey
    return scene


def blurred(rng: np.random.Generator) -> Scene:
    """Shaken photographs of a dark object."""
    scene = Scene(corner_of_walls(rng), *around(rng, 6))
    lengths = rng.uniform(3, 14, 6)

    def shaken(i: int, grey: FloatArray) -> FloatArray:
        kernel = np.zeros((15, 15))
        cv2.line(kernel, (7, 7), (7 + round(lengths[i] / 2), 7 - round(lengths[i] / 3)), 1.0)
        dark = cv2.filter2D(grey, -1, kernel / kernel.sum()) * 0.25
        return np.asarray(dark + rng.normal(0, 4, grey.shape))

    scene.finish = shaken
    return scene


def zoomed(rng: np.random.Generator) -> Scene:
    """A zoom that slipped between some of the photographs."""
    scene = Scene(corner_of_walls(rng), *around(rng, 9))
    scene.c = C_PX * np.where(np.isin(np.arange(9), (3, 4, 7)), rng.uniform(1.03, 1.15), 1.0)
    return scene


def low_overlap(rng: np.random.Generator) -> Scene:
    """A long wall in a strip of photographs that overlap by a third."""
    planes = [wall(rng, np.zeros(3), np.array([28.0, 0.0, 0.3]), np.array([0.0, 7.0, 0.0]))]
    planes[0] = Plane(
        planes[0].corner, planes[0].right, planes[0].up, natural_texture(rng, (4 * TEXTURE_PX, TEXTURE_PX))
    )
    position = np.column_stack([3.6 * np.arange(-3, 4), rng.uniform(-0.2, 0.2, 7), np.full(7, 5.0)])
    directions = np.column_stack([rng.normal(0, 0.08, (7, 2)), -np.ones(7)])
    return Scene(planes, position, np.array([upright(one) for one in directions]))


def turntable(rng: np.random.Generator, count: int = 24, step: float = 2 * np.pi / 24) -> Scene:
    """An object that turns before a camera and a textured room that stand still, in the frame of the object.

    It covers a third of the photographs.
    """
    around_object = [
        (np.array([np.sin(turn), 0.0, np.cos(turn)]), np.array([np.cos(turn), 0.0, -np.sin(turn)]))
        for turn in 0.3 + np.pi / 2 * np.arange(4)
    ]
    up, half, top = np.array([0.0, 2.2, 0.0]), 1.15, np.array([0.0, 2.2, 0.0])
    sides = [wall(rng, half * out + up / 2, 2 * half * right, up) for out, right in around_object]
    (out, right), *_ = around_object
    lid = wall(rng, top, 2 * half * right, -2 * half * out)
    room = [
        wall(rng, np.array([0.0, 2.0, -4.0]), np.array([16.0, 0.0, 0.0]), np.array([0.0, 10.0, 0.0])),
        wall(rng, np.array([0.0, -0.1, 0.0]), np.array([16.0, 0.0, 0.0]), np.array([0.0, 0.0, -9.0])),
    ]
    station, aim = np.array([0.0, 3.2, 5.6]), np.array([0.0, 1.0, 0.0])
    view = upright(aim - station)
    scene = Scene([*sides, lid], np.zeros((count, 3)), np.zeros((count, 3, 3)))
    for i in range(count):
        cos, sin = np.cos(step * i), np.sin(step * i)
        turned = np.array([[cos, 0.0, sin], [0.0, 1.0, 0.0], [-sin, 0.0, cos]])
        scene.position[i], scene.rotation[i] = turned @ station, turned @ view
        facing = [
            side
            for side, (out, _) in zip(sides, around_object, strict=True)
            if (scene.position[i] - half * out) @ out > 0
        ]
        behind = [
            Plane(turned @ one.corner, turned @ one.right, turned @ one.up, one.texture) for one in room
        ]
        scene.in_photograph[i] = [*behind, *facing, lid]
    return scene


def write_masks(folder: Path, scene: Scene) -> None:
    """Write the masks of photographs, white where they show planes of the scene and not others before it."""
    folder.mkdir()
    for i in range(len(scene.position)):
        shown = [
            Plane(one.corner, one.right, one.up, np.full_like(one.texture, 255.0))
            for one in scene.in_photograph[i]
            if any(one is plane for plane in scene.planes)
        ]
        alone = Scene(shown, scene.position, scene.rotation)
        mask = np.where(_photograph(alone, i) > 128, 255, 0).astype(np.uint8)
        cv2.imwrite(str(folder / f"photo_{i:02d}.png.png"), mask)


KINDS: dict[str, Callable[[np.random.Generator], Scene]] = {
    one.__name__: one
    for one in (
        *(usual, street, frontal_wall, no_base, repeated, water, walkers, reflections, two_objects),
        *(mirrored, blurred, zoomed, low_overlap),
    )
}


def _photograph(scene: Scene, i: int) -> FloatArray:
    """Return the photograph from a station, without noise, twice as fine as it is stored."""
    w, h = 2 * SIZE_PX[0], 2 * SIZE_PX[1]
    c = 2 * (C_PX if scene.c is None else scene.c[i])
    P = (
        np.array([[-c, 0, w / 2], [0, c, h / 2], [0, 0, 1.0]])
        @ np.diag([1.0, 1.0, 1.0])
        @ scene.rotation[i].T
    )
    P = np.array([[c, 0, -w / 2], [0, -c, -h / 2], [0, 0, -1.0]]) @ scene.rotation[i].T
    grey = np.full((h, w), 40.0)
    for one in scene.in_photograph.get(i, scene.planes):
        tall, wide = one.texture.shape
        place = np.column_stack([one.right / wide, -one.up / tall, one.corner + one.up - scene.position[i]])
        H = P @ place
        corners = H @ np.array([[0, wide, wide, 0], [0, 0, tall, tall], [1.0, 1, 1, 1]])
        if (corners[2] <= 0.05).all():
            continue  # behind the camera
        value, there = _warped(one.texture, H, (w, h))
        grey = np.where(there, value, grey)
    reduced = np.asarray(cv2.resize(grey, SIZE_PX, interpolation=cv2.INTER_AREA), dtype=float)
    return scene.finish(i, reduced)


def _warped(texture: FloatArray, H: FloatArray, size: tuple[int, int]) -> tuple[FloatArray, BoolArray]:
    """Return a texture seen through a homography, before the camera only, and where it is."""
    w, h = size
    y, x = np.mgrid[0:h, 0:w].astype(np.float32) + 0.5
    back = np.linalg.inv(H)
    s = [row[0] * x + row[1] * y + row[2] for row in back]
    u, v = s[0] / s[2], s[1] / s[2]
    depth = H[2, 0] * u + H[2, 1] * v + H[2, 2]
    tall, wide = texture.shape
    there = (depth > 0.05) & (u > 0) & (u < wide - 1) & (v > 0) & (v < tall - 1)
    step = np.abs(np.gradient(u, axis=1)) + np.abs(np.gradient(v, axis=0))  # texture pixels for one
    value = np.zeros((h, w))
    smooth = np.asarray(texture, dtype=float)
    for level in range(4):
        scale = 2**level
        rows = (step / 2 < scale) | (level == 3)
        rows &= (step / 2 >= scale / 2) | (level == 0)
        seen = cv2.remap(
            smooth, (u / scale - 0.5).astype(np.float32), (v / scale - 0.5).astype(np.float32),
            cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE,
        )  # fmt: skip
        value = np.where(rows, seen, value)
        smooth = np.asarray(
            cv2.resize(smooth, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA), dtype=float
        )
    return value, there


def write_scene(folder: Path, scene: Scene, rng: np.random.Generator) -> None:
    """Write the photographs of a scene and the survey that is drafted for them."""
    for i in range(len(scene.position)):
        grey = _photograph(scene, i) + rng.normal(0, NOISE, SIZE_PX[::-1])
        path = folder / f"photo_{i:02d}.png"
        cv2.imwrite(str(path), np.clip(np.rint(grey), 0, 255).astype(np.uint8))
    (folder / "survey.toml").write_text(draft_survey(folder).text, encoding="utf-8")


@dataclass(frozen=True)
class Outcome:
    """What a survey of a scene gave."""

    level: str  # good, fair or bad; none where the survey ended without a result
    oriented: int
    over_sigma: float  # error of the projection centres over what is stated for them, RMS
    share: float  # the same over the extent of the centres
    kinds: tuple[str, ...]  # of the remarks, or the message

    @property
    def is_wrong(self) -> bool:
        """Whether the centres are not where they are stated to be."""
        return self.over_sigma > WRONG and self.share > SHARE

    @property
    def is_wrong_and_believed(self) -> bool:
        """Whether nothing tells so."""
        return self.is_wrong and self.level in ("good", "fair")


def outcome_of(folder: Path, scene: Scene) -> Outcome:
    """Return what the survey of a folder gives against the stations of its scene."""
    try:
        result = run_survey(read_survey(folder / "survey.toml"))
    except KolinearError as error:
        return Outcome("none", 0, np.nan, np.nan, (str(error).splitlines()[0],))
    verdict = findings_of(result).verdict
    over_sigma, share, oriented = _errors(result, scene)
    return Outcome(verdict.level, oriented, over_sigma, share, kinds_of(verdict.remarks))


def _errors(result: SurveyResult, scene: Scene) -> tuple[float, float, int]:
    """Return the error of centres over sigma and over their extent, RMS, and how many are oriented."""
    a = result.adjustment
    on = np.array([int(name.split("_")[1][:2]) for name in a.network.images])
    truth = scene.position[on]
    if len(on) < 3:
        return np.nan, np.nan, len(on)
    placed = fit_similarity(a.estimate.position, truth)
    error = placed.apply(a.estimate.position) - truth
    extent = float(np.sqrt(((truth - truth.mean(axis=0)) ** 2).sum(axis=1).mean()))
    rms = float(np.sqrt((error**2).sum(axis=1).mean()))
    m = len(on)
    of_centres = np.diagonal(covariance_on_centres(a)).reshape(m, 6)[:, :3]
    variance = of_centres.sum(axis=1).mean()
    stated = placed.scale * float(np.sqrt(max(variance, 0.0)))
    return rms / stated if stated > 0 else np.inf, rms / extent, m


def study(first: int, end: int, kinds: list[str]) -> list[tuple[str, int, Outcome]]:
    """Run the surveys of some scenes and print a line for each."""
    found = []
    for kind in kinds:
        for number in range(first, end):
            rng = seed_of(f"{kind} {number}")
            with tempfile.TemporaryDirectory() as name:
                folder = Path(name)
                scene = KINDS[kind](rng)
                write_scene(folder, scene, rng)
                one = outcome_of(folder, scene)
            found.append((kind, number, one))
            mark = "WRONG AND BELIEVED" if one.is_wrong_and_believed else "wrong" if one.is_wrong else ""
            print(
                f"{kind:<13}{number:>3} {one.level:<5}{one.oriented:>3}/{len(scene.position):<3}"
                f"{one.over_sigma:>8.1f} sigma{100 * one.share:>8.2f} %  {mark} {', '.join(one.kinds)}",
                flush=True,
            )
    levels = {level: sum(one.level == level for _, _, one in found) for level in LEVELS}
    wrong, believed = (
        sum(getattr(one, name) for _, _, one in found) for name in ("is_wrong", "is_wrong_and_believed")
    )
    print(f"{len(found)} scenes: {levels}; wrong {wrong}, of these believed {believed}")
    return found


if __name__ == "__main__":
    numbers = [int(one) for one in sys.argv[1:] if one.isdigit()]
    chosen = [one for one in sys.argv[1:] if not one.isdigit()] or list(KINDS)
    study(numbers[0] if numbers else 0, numbers[1] if len(numbers) > 1 else NUMBERS, chosen)
