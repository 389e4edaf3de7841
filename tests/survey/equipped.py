"""Surveys with rigs, tables of survey observations and certified bars: right ones, and with one mistake each.

`equipped(kind, number, folder)` depends on its arguments only. Calibrated cameras, object unit m.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from sfm.model.conventions import FloatArray, angles_from_rotation
from sfm.model.estimate import Estimate
from sfm.model.network import ImagePoints, Network
from sfm.model.observations.kind import Group, TableKind
from tests.rigs import make_rig
from tests.survey.test_rigs import RIG, written
from tests.survey.test_survey_observations import network_of, table_of
from tests.synthetic import make_network, seed_of

BASE = ("distance", "height difference", "coordinate difference")  # one table of each beside two others
OTHERS = (
    *("zenith angle", "horizontal direction", "relative orientation", "rigid frame", "plane", "level"),
    "distance with additive constant",
)
Change = Callable[[FloatArray, FloatArray], tuple[FloatArray, FloatArray]]  # of a position and a rotation
BAR_SIGMA = 1e-5  # of a certified length, m


@dataclass
class Equipped:
    """A survey to be written, and what was planted."""

    rng: np.random.Generator
    network: Network
    truth: Estimate
    tables: dict[str, list[TableKind]] = field(default_factory=dict)
    blocks: str = ""  # of the survey file
    files: dict[str, str] = field(default_factory=dict)
    causes: tuple[str, ...] = ()  # kinds of remarks that are right, none for a right survey
    names: tuple[str, ...] = ()  # one of these is in the remark


def _tables(scene: Equipped) -> None:
    words = (*BASE, *scene.rng.choice(OTHERS, 2, replace=False).tolist())
    scene.network, scene.truth = network_of(f"tables {scene.rng.integers(1 << 30)}", words)
    scene.tables = {word: [kind] for word, kind in zip(words, scene.network.further, strict=True)}


def _changed(scene: Equipped) -> str:
    """Return a kind of tables whose rows depend on no further unknown."""
    words = [word for word, (kind,) in scene.tables.items() if not isinstance(kind, Group)]
    return str(scene.rng.choice(words))


def _row_wrong(scene: Equipped) -> None:
    _tables(scene)
    word = _changed(scene)
    (kind,) = scene.tables[word]
    row, axis = int(scene.rng.integers(len(kind))), int(scene.rng.integers(kind.values.shape[1]))
    values = kind.values.copy()
    size = np.exp(scene.rng.uniform(np.log(50), np.log(1000))) * scene.rng.choice([-1.0, 1.0])
    values[row, axis] += size * kind.sigma[row, axis]
    scene.tables[word] = [kind.with_values(values)]
    scene.causes, scene.names = ("observations_wrong", "scale_left_out"), (kind.single, "bar")


def _table_mistaken(scene: Equipped) -> None:
    _tables(scene)
    word = _changed(scene)
    (kind,) = scene.tables[word]
    mistakes = kind.mistakes()
    mistake = str(scene.rng.choice(list(mistakes)))
    mended = mistakes[mistake]
    assert isinstance(mended, TableKind)
    scene.tables[word] = [mended]
    scene.causes, scene.names = ("kind_wrong", "observations_wrong"), (kind.name,)


def _sigmas_small(scene: Equipped) -> None:
    _tables(scene)
    word = _changed(scene)
    (kind,) = scene.tables[word]
    noise = scene.rng.standard_normal(kind.values.shape)
    scene.tables[word] = [kind.with_values(kind.values + 5 * kind.sigma * noise)]
    scene.causes, scene.names = ("given_sigmas", "kind_wrong"), (kind.name,)


def _rig(scene: Equipped) -> None:
    cameras = int(scene.rng.integers(2, 4))
    scene.network, scene.truth = make_rig(
        scene.rng, cameras=cameras, moments=int(scene.rng.integers(5, 10)), points=30
    )
    names = ", ".join(f'"camera {a + 1}"' for a in range(cameras))
    scene.blocks = RIG.replace('"camera 1", "camera 2"', names)


def _photograph_of_second(scene: Equipped) -> int:
    return int(scene.rng.choice(np.flatnonzero(np.asarray(scene.network.camera) == 1)))


def _bumped(scene: Equipped) -> None:
    """One photograph whose camera is turned in its mount: image points shifted as by a rotation."""
    _rig(scene)
    i = _photograph_of_second(scene)
    camera, seen = scene.truth.cameras[1], scene.network.image_points
    angle = np.radians(np.exp(scene.rng.uniform(np.log(0.05), np.log(0.5))))
    xy = seen.xy.copy()
    xy[seen.image == i, 0] += np.tan(angle) * camera.value("c") / camera.pixel_mm[0]
    scene.network = replace(scene.network, image_points=replace(seen, xy=xy))
    scene.causes, scene.names = ("rig_contradicted",), (scene.network.images[i],)


def _wrongly_paired(scene: Equipped) -> None:
    """Two photographs of a camera in each other's place."""
    _rig(scene)
    i, j = scene.rng.choice(np.flatnonzero(np.asarray(scene.network.camera) == 1), 2, replace=False)
    seen = scene.network.image_points
    image = np.where(seen.image == i, j, np.where(seen.image == j, i, seen.image))
    order = np.lexsort((seen.point, image))
    moved = ImagePoints(image[order], seen.point[order], seen.xy[order], seen.covariance[order])
    scene.network = replace(scene.network, image_points=moved)
    scene.causes = ("rig_contradicted",)
    scene.names = (scene.network.images[int(i)], scene.network.images[int(j)])


def _mounts(
    scene: Equipped, change: Callable[[FloatArray, FloatArray], tuple[FloatArray, FloatArray]]
) -> None:
    _rig(scene)
    mounts = scene.truth.mounts
    assert mounts is not None
    rows = ["camera,X,Y,Z,omega_deg,phi_deg,kappa_deg,sX,sY,sZ,somega_deg,sphi_deg,skappa_deg"]
    for a in range(1, len(mounts.position)):
        P, R = change(mounts.position[a], mounts.rotation[a])
        P = P + 1e-4 * scene.rng.standard_normal(3)
        angles = np.degrees(angles_from_rotation(R)) + 0.005 * scene.rng.standard_normal(3)
        rows.append(",".join([f"camera {a + 1}", *map(repr, [*P.tolist(), *angles.tolist()])]))
        rows[-1] += ",1e-4,1e-4,1e-4,0.005,0.005,0.005"
    scene.files["mounts.csv"] = "\n".join(rows) + "\n"
    scene.blocks += 'mounts = "mounts.csv"\n'


def _mounts_right(scene: Equipped) -> None:
    _mounts(scene, lambda P, R: (P, R))


def _mounts_inverse(scene: Equipped) -> None:
    _mounts(scene, lambda P, R: (-R.T @ P, R.T))
    scene.causes, scene.names = ("mount_contradicted",), ("camera 2", "camera 3")


def _bars(scene: Equipped, factor: Callable[[int], float]) -> None:
    """Pairs of points that certified bars of 20 degrees connect, each a bar of its own."""
    scene.network, scene.truth = make_network(scene.rng, images=8, points=40, free=())
    count = int(scene.rng.integers(4, 7))
    pairs = scene.rng.permutation(40)[: 2 * count].reshape(count, 2)
    text = 'unit = "mm"\n'
    for k, (i, j) in enumerate(pairs.tolist()):
        length = float(np.linalg.norm(scene.truth.points[i] - scene.truth.points[j]))
        length = length * factor(k) + BAR_SIGMA * float(scene.rng.standard_normal())
        text += f'[[bar]]\nname = "bar {k + 1}"\ncalibrated = 2026-01-01\n'
        text += f"points = {[scene.network.points[i], scene.network.points[j]]}\n".replace("'", '"')
        text += f"length = {1e3 * length!r}\nsigma = {1e3 * BAR_SIGMA!r}\nexpansion = 11.5\n"
        scene.blocks += f'[[equipment]]\nname = "bar {k + 1}"\n'
    scene.files["equipment.toml"] = text


def _bars_right(scene: Equipped) -> None:
    _bars(scene, lambda _: 1.0)


def _bar_wrong(scene: Equipped) -> None:
    size = float(np.exp(scene.rng.uniform(np.log(2e-3), np.log(0.1))))
    _bars(scene, lambda k: 1.0 + size * (k == 1))
    scene.causes = ("scale_left_out",)


EQUIPPED: dict[str, Callable[[Equipped], None]] = {
    "tables": _tables,
    "rig": _rig,
    "mounts": _mounts_right,
    "certified bars": _bars_right,
    "row wrong": _row_wrong,
    "table mistaken": _table_mistaken,
    "sigmas small": _sigmas_small,
    "bumped": _bumped,
    "wrongly paired": _wrongly_paired,
    "mounts inverse": _mounts_inverse,
    "bar wrong": _bar_wrong,
}


def equipped(kind: str, number: int, folder: Path) -> tuple[Path, Equipped]:
    """Write the survey of a kind and a number into a folder; return its file and what it is."""
    scene = Equipped(seed_of(f"equipped {kind} {number}"), *make_network(seed_of("none"), images=3, points=9))
    EQUIPPED[kind](scene)
    blocks = scene.blocks + table_of(folder, scene.network, scene.tables)
    path = written(folder, scene.network, scene.truth, blocks)
    if "equipment.toml" in scene.files:
        head = 'unit = "m"\nequipment = "equipment.toml"\ntemperature = 20.0\n'
        path.write_text(path.read_text("utf-8").replace('unit = "m"\n', head, 1), "utf-8")
    for name, text in scene.files.items():
        (folder / name).write_text(text, "utf-8")
    return path, scene
