"""What is fuzzed: good files of every kind, and how each is read."""

from __future__ import annotations

import io
import random
import shutil
import sqlite3
import tempfile
import warnings
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
from PIL import Image

from adapters.colmap.camera_models import read_model, write_model
from adapters.formats.cameras.registry import CAMERA_FORMATS, read_cameras, write_cameras
from adapters.formats.registry import read_any, write_any
from adapters.formats.result_tables import read_result, write_tables
from adapters.formats.sba_text import read_sba_text
from sfm.model.camera import camera_from_values
from sfm.model.camera_file import CameraFile
from sfm.model.errors import KolinearError
from sfm.model.solution import Solution
from sfm.photographs.exif import read_metadata
from sfm.photographs.reading import read_photograph
from sfm.pipeline import run_survey
from sfm.survey.inputs.exterior_table import read_observed_exterior
from sfm.survey.inputs.given_values import (
    read_control,
    read_exterior,
    read_image_points,
    read_points,
)
from sfm.survey.inputs.measurements import find_photographs
from sfm.survey.inputs.survey import read_survey
from sfm.survey.sources.given import measure_given
from sfm.targets.codes.rings import read_code_table
from sfm.targets.detect import find_targets
from tests.fuzz.mutate import mutate_bytes, mutate_text
from tests.synthetic import make_network, seed_of

SURVEY = """\
[survey]
name = "fuzz"
unit = "m"
[[camera]]
name = "synthetic"
images = "image*"
size_px = [2000, 1500]
pixel_mm = [0.005, 0.005]
c_mm = 10.0
model = "brown"
free = ["c", "x0", "y0"]
[camera.fixed]
K1 = 8e-4
K2 = -4e-6
[targets]
polarity = "dark"
codes = "codes.txt"
min_diameter_px = 6
[datum]
kind = "control"
[control]
file = "control.csv"
[exterior]
file = "exterior.csv"
[[scale_bar]]
from = "1"
to = "2"
length = 1.2
sigma = 0.001
[observations]
file = "image_points.csv"
[approximate]
images = "images.csv"
points = "points.csv"
[adjust]
sigma_px = 0.1
reject = "tau"
[compare]
backend = "none"
"""
SOLVED_SHARE = 0.03  # of what can be read is adjusted, too, which takes longer


@dataclass(frozen=True)
class Seed:
    """A good file and how it is read."""

    kind: str
    name: str
    content: str | bytes
    read: Callable[[Path, random.Random], None]  # the folder that holds it among its good neighbours


def make_seeds(folder: Path) -> tuple[Seed, ...]:
    """Write a folder of good files and return the seeds; one file is exchanged for each mutation."""
    texts = _tables()
    for name, text in texts.items():
        (folder / name).write_text(text, encoding="utf-8")
    pictures = _pictures()
    network, truth = make_network(seed_of("fuzz model"), images=3, points=8, model="opencv")
    models: dict[str, str | bytes] = {}
    for kind in ("bin", "txt"):
        write_model(folder / kind, network, truth, text=kind == "txt")
        for path in sorted((folder / kind).iterdir()):
            models[f"{kind}/{path.name}"] = path.read_bytes() if kind == "bin" else path.read_text("utf-8")
    seeds = [Seed("surveys", "survey.toml", SURVEY, _read_survey)]
    seeds += [
        Seed("tables", name, text, _read_survey) for name, text in texts.items() if name.endswith(".csv")
    ]
    seeds += [Seed("tables", name, texts[name], read) for name, read in _TABLES]
    seeds += [
        Seed("codes", "codes.txt", texts["codes.txt"], lambda f, _: _drop(read_code_table(f / "codes.txt")))
    ]
    seeds += [Seed("photographs", name, data, _reader_of_photograph(name)) for name, data in pictures.items()]
    seeds += [
        Seed("models", name, data, lambda f, _, kind=name.split("/")[0]: _drop(read_model(f / kind)))
        for name, data in models.items()
    ]
    seeds += [Seed("models", name, text, read) for name, text, read in _OTHER_PROGRAMS]
    seeds += _results(folder)
    seeds += _cameras(folder)
    seeds += [Seed("folders", "unused", b"x", _read_folder), Seed("rows", "unused", b"x", _read_rows)]
    for seed in seeds:
        path = folder / seed.name
        if isinstance(seed.content, bytes):
            path.write_bytes(seed.content)
        else:
            path.write_text(seed.content, encoding="utf-8")
    return tuple(seeds)


def _results(folder: Path) -> list[Seed]:
    """Return the tables of a result and the files of other programs."""
    network, truth = make_network(seed_of("fuzz result"), images=3, points=8, model="opencv", visibility=1.0)
    network = replace(network, images=("a.jpg", "b.jpg", "c.jpg"))
    camera = truth.cameras[0]
    plain = camera.with_parameters(camera.parameters[[1, 1, 2, 3, 4, 5, 6, 7]] * ([1] * 4 + [0] * 4))
    ideal = replace(truth, cameras=(plain,))
    sigma = np.tile(np.eye(3) * 1e-6, (8, 1, 1))
    write_tables(folder / "result", Solution("fuzz", network, truth, sigma, sigma[:3], redundancy=5))
    write_any(folder / "m.xml", "metashape", network, truth)
    write_any(folder / "bal.txt", "bal", network, ideal)
    write_any(folder / "sba", "sba", network, ideal)
    brown = camera_from_values("camera", "brown", camera.size_px, (0.005, 0.005), c_mm=10.0)
    write_any(folder / "bundle", "bundle-matlab", network, replace(truth, cameras=(brown,)))
    write_any(folder / "8pts.txt", "bundle-csharp", network, replace(truth, cameras=(brown,)))
    write_any(folder / "pm", "photomodeler", network, replace(truth, cameras=(brown,)))
    lens = camera_from_values("camera", "radial", camera.size_px, (1.0, 1.0), c_mm=2000.0)
    forward = camera_from_values("camera", "brown_forward", camera.size_px, (1.0, 1.0), c_mm=2000.0)
    models = {"opensfm": camera, "nerfstudio": camera, "alicevision": camera}
    models |= {"bundler": lens, "nvm": brown, "openmvg": forward}
    models |= dict.fromkeys(("micmac", "aicon", "realitycapture", "agisoft-reference", "points-csv"), forward)
    for form, of_form in models.items():
        write_any(folder / form, form, network, replace(truth, cameras=(of_form,)))
    write_any(folder / "scene.db", "colmap-database", network, truth)
    shutil.copy(folder / "scene.db", folder / "good.db")
    found: list[Seed] = []
    for name in ("summary.json", "points.csv", "images.csv", "cameras.csv", "image_points.csv"):
        text = (folder / "result" / name).read_text("utf-8")
        found.append(Seed("results", f"result/{name}", text, lambda f, _: _drop(read_result(f / "result"))))
    files = [("m.xml", "m.xml", "metashape"), ("bal.txt", "bal.txt", "bal"), ("pm", "pm", "photomodeler")]
    files += [("8pts.txt", "8pts.txt", "bundle-csharp")]
    files += [(f"sba/{name}", "sba", "sba") for name in ("cams.txt", "pts.txt")]
    files += [
        (f"bundle/{name}", "bundle", "bundle-matlab")
        for name in ("cams.txt", "pts.txt", "sigmas.txt", "interior.txt")
    ]
    files += [(name, name, name) for name in ("nerfstudio", "alicevision", "nvm", "openmvg")]
    files += [(name, name, name) for name in ("realitycapture", "points-csv")]
    files += [
        (f"micmac/{name}", "micmac", "micmac")
        for name in ("AutoCal-0.xml", f"Orientation-{network.images[0]}.xml", "MesuresIm.xml")
    ]
    files += [(f"aicon/survey.{ending}", "aicon", "aicon") for ending in ("ior", "eor", "obc", "phc")]
    files += [
        (f"agisoft-reference/{name}", "agisoft-reference", "agisoft-reference")
        for name in ("cameras.csv", "markers.csv")
    ]
    files += [(f"opensfm/{name}", "opensfm", "opensfm") for name in ("reconstruction.json", "tracks.csv")]
    files += [(f"bundler/{name}", "bundler", "bundler") for name in ("bundle.out", "list.txt")]
    for name, whole, form in files:
        text = (folder / name).read_text("utf-8")
        found.append(Seed("results", name, text, _reader_of(whole, form)))
    found.append(
        Seed(
            "results",
            "scene.db",
            (folder / "scene.db").read_bytes(),
            _reader_of("scene.db", "colmap-database"),
        )
    )
    return found


def _cameras(folder: Path) -> list[Seed]:
    """Return files of cameras of other programs, read by their content and by name."""
    values = (("fx", 500.0), ("fy", 501.0), ("cx", 320.0), ("cy", 240.0), ("k1", -0.2), ("p1", 1e-3))
    radtan = camera_from_values("left", "opencv", (640, 480), (1.0, 1.0), c_mm=500.0, values=values)
    lenses = {
        "australis-camera": camera_from_values("a", "brown", (640, 480), (0.01, 0.01), c_mm=5.0),
        "blender-camera": camera_from_values("b", "pinhole", (640, 480), (0.01, 0.01), c_mm=5.0),
    }
    found = []
    (folder / "lenses").mkdir()
    for form in CAMERA_FORMATS:
        for suffix in form.suffixes:
            name = f"lenses/{form.name}{suffix}"
            write_cameras(
                folder / name, form.name, CameraFile("x", (lenses.get(form.name, radtan),), (None,))
            )
            data = (folder / name).read_bytes()
            content = data if suffix == ".bin" else data.decode()

            def read(f: Path, rng: random.Random, name: str = name, form: str = form.name) -> None:
                _drop(read_cameras(f / name, rng.choice([None, form])))

            found.append(Seed("cameras", name, content, read))
    return found


def _read_folder(folder: Path, rng: random.Random) -> None:
    """Look for the photographs of a survey in a folder with links out of it, in circles, or nowhere."""
    with tempfile.TemporaryDirectory(dir=folder) as name:
        inner = Path(name)
        shutil.copy(folder / "survey.toml", inner)
        for file, text in _tables().items():
            (inner / file).write_text(text, encoding="utf-8")
        for place in ("image1", "sub", "a/b/image2", "control.csv", "survey.toml/x", "codes.txt"):
            target = rng.choice(
                ("/", "..", ".", "/etc/passwd", "/dev/zero", "/proc", "nowhere", str(folder), place)
            )
            link = inner / place
            with suppress(OSError):
                link.parent.mkdir(parents=True, exist_ok=True)
                link.unlink(missing_ok=True)
                link.symlink_to(target)
        survey = read_survey(inner / "survey.toml")
        pattern = rng.choice(("**/*", "sub/**/*", "*/*/*", "sub/*", "a/**/image*", "**/sub/**/x*", "im*"))
        cameras = tuple(camera.model_copy(update={"images": (pattern,)}) for camera in survey.cameras)
        found = replace(survey, cameras=cameras)
        if rng.random() < 0.3:
            measure_given(found)
        for path in find_photographs(found).paths:
            assert path.resolve().is_relative_to(inner.resolve())


def _read_rows(folder: Path, rng: random.Random) -> None:
    """Read a database of which a cell is another."""
    path = folder / "rows.db"
    path.write_bytes((folder / "good.db").read_bytes())
    database = sqlite3.connect(path)
    try:
        for _ in range(rng.choice((1, 1, 2, 4))):
            table = rng.choice(tuple(COLUMNS))
            value = rng.choice((*VALUES, rng.randbytes(rng.choice((0, 1, 8, 64, 128)))))
            which = rng.choice(("1 = 1", "rowid = (SELECT min(rowid) FROM " + table + ")"))
            with suppress(sqlite3.Error, OverflowError):
                database.execute(
                    f"UPDATE {table} SET {rng.choice(COLUMNS[table])} = ? WHERE {which}", (value,)
                )
        database.commit()
    finally:
        database.close()
    _drop(read_any(path, "colmap-database"))


COLUMNS = {
    "cameras": ("camera_id", "model", "width", "height", "params"),
    "images": ("image_id", "name", "camera_id"),
    "keypoints": ("image_id", "rows", "cols", "data"),
    "matches": ("pair_id", "rows", "cols", "data"),
    "two_view_geometries": ("pair_id", "rows", "cols", "data"),
}
VALUES = (
    None,
    -1,
    0,
    1,
    2,
    7,
    2**31,
    2**63 - 1,
    -(2**63),
    1.5,
    float("inf"),
    "",
    "1",
    "../a",
    "a\u202eb",
)


def _reader_of(name: str, form: str) -> Callable[[Path, random.Random], None]:
    return lambda folder, _: _drop(read_any(folder / name, form))


def mutated(seed: Seed, rng: random.Random) -> bytes:
    """Return the content of a file with something wrong."""
    if isinstance(seed.content, bytes):
        return mutate_bytes(rng, seed.content)
    data = mutate_text(rng, seed.content).encode("utf-8", "surrogatepass")
    return mutate_bytes(rng, data) if rng.random() < 0.1 else data


def run_case(seed: Seed, data: bytes, folder: Path, rng: random.Random) -> str:
    """Read a file with other content; return "" or what went wrong. The good file is put back."""
    path = folder / seed.name
    good = seed.content if isinstance(seed.content, bytes) else seed.content.encode()
    path.write_bytes(data)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            seed.read(folder, rng)
    except KolinearError as error:
        told = str(error)
        if not told or "\n" in told or len(told) > 2000:
            return f"not one clear line: {told[:200]!r}"
    except Exception as error:
        place = error.__traceback__
        while place is not None and place.tb_next is not None:
            place = place.tb_next
        at = f"{place.tb_frame.f_code.co_filename}:{place.tb_lineno}" if place is not None else ""
        return f"{type(error).__name__}: {str(error)[:150]} at {at}"
    finally:
        path.write_bytes(good)
    return ""


def _drop(value: object) -> None:
    """Do nothing with what was read."""


def _read_survey(folder: Path, rng: random.Random) -> None:
    survey = read_survey(folder / "survey.toml")
    if survey.observations is None:
        find_photographs(survey)
        return
    measure_given(survey)
    if rng.random() < SOLVED_SHARE:
        run_survey(survey)


def _reader_of_photograph(name: str) -> Callable[[Path, random.Random], None]:
    def read(folder: Path, rng: random.Random) -> None:
        read_metadata(folder / name)
        picture = read_photograph(folder / name)
        if picture.size < 1_000_000 and rng.random() < 0.2:
            find_targets(picture, codes="ring14")

    return read


_TABLES: tuple[tuple[str, Callable[[Path, random.Random], None]], ...] = (
    ("control.csv", lambda f, _: _drop(read_control(f / "control.csv"))),
    ("exterior.csv", lambda f, _: _drop(read_observed_exterior(f / "exterior.csv"))),
    ("images.csv", lambda f, _: _drop(read_exterior(f / "images.csv"))),
    ("points.csv", lambda f, _: _drop(read_points(f / "points.csv"))),
    ("image_points.csv", lambda f, _: _drop(read_image_points(f / "image_points.csv"))),
)
SBA_CAMERAS = "1 0 0 0 0 0 0\n1 0 0 0 1 0 0\n"
SBA_POINTS = "0 0 5 2 0 320 240 1 310 240\n1 0 5 2 0 420 240 1 410 240\n0 1 5 2 0 320 340 1 310 340\n"
SBA_CALIBRATION = "800 0 320\n0 800 240\n0 0 1\n"


def _read_sba(folder: Path, rng: random.Random) -> None:
    read_sba_text(folder / "cams.txt", folder / "pts.txt", folder / "calib.txt")


_OTHER_PROGRAMS: tuple[tuple[str, str, Callable[[Path, random.Random], None]], ...] = (
    ("cams.txt", SBA_CAMERAS, _read_sba),
    ("pts.txt", SBA_POINTS, _read_sba),
    ("calib.txt", SBA_CALIBRATION, _read_sba),
)


def _tables() -> dict[str, str]:
    """Return the tables of the survey above."""
    network, truth = make_network(seed_of("fuzz"), images=5, points=12, free=("c",))
    seen = network.image_points
    points = "".join(
        f"{network.images[i]},{network.points[j]},{x:.3f},{y:.3f},0.1,0.1\n"
        for i, j, (x, y) in zip(seen.image, seen.point, seen.xy, strict=True)
    )
    xyz = [
        f"{name},{x:.6f},{y:.6f},{z:.6f}"
        for name, (x, y, z) in zip(network.points, truth.points, strict=True)
    ]
    images = "".join(f"{name},0.1,0.2,4.0,1.0,-2.0,{10 * k}.0\n" for k, name in enumerate(network.images))
    seen_from = "".join(
        f"{name},{x:.4f},{y:.4f},{z:.4f},0.01,0.01,0.01,,,,,,\n"
        for name, (x, y, z) in zip(network.images[:3], truth.position, strict=False)
    )
    return {
        "exterior.csv": "image,X,Y,Z,sX,sY,sZ,omega_deg,phi_deg,kappa_deg,somega_deg,sphi_deg,skappa_deg\n"
        + seen_from
        + f"{network.images[3]},,,,,,,1.0,-2.0,30.0,0.1,0.1,0.1\n",
        "image_points.csv": "image,point,x_px,y_px,sx_px,sy_px\n" + points,
        "control.csv": "id,X,Y,Z,sX,sY,sZ\n" + "".join(f"{row},0.001,0.001,0\n" for row in xyz[:5]),
        "points.csv": "point,X,Y,Z\n" + "\n".join(xyz) + "\n",
        "images.csv": "image,X,Y,Z,omega_deg,phi_deg,kappa_deg\n" + images,
        "codes.txt": "# cells 12\n1 65\n2 195\n3 325\n",
    }


def _pictures() -> dict[str, bytes]:
    """Return small photographs with a target, in all formats and depths."""
    grey = np.full((48, 64), 200, np.uint8)
    cv2.circle(grey, (30, 24), 9, 40, -1)
    exif = Image.Exif()
    exif[0x0112], exif[0x010F], exif[0x0110] = 1, "Maker", "Model"
    inner = exif.get_ifd(0x8769)
    inner[0x920A], inner[0xA405], inner[0xA20E], inner[0xA20F], inner[0xA210] = 7.3, 38, 300.0, 300.0, 3
    inner[0xA002] = 64
    jpeg, progressive = io.BytesIO(), io.BytesIO()
    Image.fromarray(grey).save(jpeg, "JPEG", exif=exif, quality=92)
    Image.fromarray(cv2.cvtColor(grey, cv2.COLOR_GRAY2RGB)).save(progressive, "JPEG", progressive=True)
    coded = {
        suffix: cv2.imencode(suffix, picture)[1].tobytes()
        for suffix, picture in ((".png", grey), (".tif", grey.astype(np.uint16) * 200), (".bmp", grey))
    }
    tiled = io.BytesIO()
    Image.fromarray(grey).save(tiled, "TIFF", compression="tiff_lzw", exif=exif)
    return {
        "a.jpg": jpeg.getvalue(),
        "b.jpg": progressive.getvalue(),
        "c.png": coded[".png"],
        "d.tif": coded[".tif"],
        "e.tif": tiled.getvalue(),
        "f.bmp": coded[".bmp"],
    }
