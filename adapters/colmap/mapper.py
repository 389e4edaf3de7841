"""COLMAP's pipeline on the photographs of a survey, and its list of sensor widths.

The pipeline is what users would run instead of a survey: without targets, scale and covariance.
`sfm.comparison.solutions` compares its photographs and points with the survey's.

Sensor widths come from COLMAP's list of cameras. pycolmap gives them only through the focal length that it
infers for a photograph. It therefore gets a small picture with the make, the model and a known focal length.

Source: Schoenberger and Frahm (2016), Structure-from-Motion revisited, CVPR; Pan, Barath, Pollefeys and
Schoenberger (2024), Global Structure-from-Motion revisited, ECCV; the pipelines of pycolmap 4.2.
"""

from __future__ import annotations

import shutil
import time
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from PIL import ExifTags, Image
from PIL.TiffImagePlugin import IFDRational

from adapters.colmap.adjuster import load_pycolmap, quiet
from adapters.colmap.camera_models import read_model
from sfm.files.user_cache import scratch_folder
from sfm.model.camera import project
from sfm.model.errors import BackendError, one_line
from sfm.model.estimate import Estimate
from sfm.model.network import Network, rows_of

SIDE_PX = (1000, 750)  # width and height of the small picture
FOCAL_MM = 10  # its known focal length
MODEL = "OPENCV"  # the COLMAP model that calibrates a lens as a survey does
RANDOM_SEED = 0  # of RANSAC, so that runs repeat as far as threads allow


@dataclass(frozen=True)
class MapperBaseline:
    """The result of COLMAP's pipeline on the photographs."""

    network: Network  # registered photographs and their SIFT points
    estimate: Estimate  # its orientations and points, in its frame and scale
    total: int  # photographs processed
    rms_px: float  # root mean square residual per coordinate of its points, px
    seconds: float  # from photographs to model, s
    name: str = "COLMAP mapper"


def map_photographs(
    folder: Path,
    cameras: tuple[tuple[str, ...], ...],
    *,
    at_once: bool = False,
    threads: int = -1,
) -> MapperBaseline:
    """Run COLMAP's pipeline on photographs and return its largest model.

    Args:
        folder: folder of the photographs.
        cameras: for each camera the names of its photographs, relative to the folder.
        at_once: whether all photographs are oriented together, by the global mapper, instead of one by one.
        threads: threads of COLMAP; -1 uses all cores.

    Raises:
        BackendError: pycolmap is missing, cannot read a photograph, or finds no model.
    """
    begun = time.perf_counter()
    with scratch_folder() as work:
        database = work / "scene.db"
        match_photographs(folder, cameras, database, threads=threads)
        mapped = map_matches(folder, database, at_once=at_once, threads=threads)
    return replace(mapped, seconds=time.perf_counter() - begun)


def match_photographs(
    folder: Path,
    cameras: tuple[tuple[str, ...], ...],
    database: Path,
    *,
    pairs: Iterable[tuple[str, str]] | None = None,
    threads: int = -1,
) -> None:
    """Write COLMAP's features of photographs, and their matches, into a new database.

    Args:
        folder: folder of the photographs.
        cameras: for each camera the names of its photographs, relative to the folder.
        database: file to write.
        pairs: names, without spaces, of the photographs that are compared; all with each other if not given.
        threads: threads of COLMAP; -1 uses all cores.

    Raises:
        BackendError: pycolmap is missing, or cannot read a photograph.
    """
    pycolmap = load_pycolmap()
    with _reported(pycolmap):
        extraction = pycolmap.FeatureExtractionOptions()
        matching = pycolmap.FeatureMatchingOptions()
        reader = pycolmap.ImageReaderOptions()
        reader.camera_model = MODEL
        extraction.num_threads = matching.num_threads = threads
        extraction.use_gpu = matching.use_gpu = False
        for names in cameras:
            pycolmap.extract_features(
                database,
                folder,
                image_names=list(names),
                camera_mode=pycolmap.CameraMode.SINGLE,
                reader_options=reader,
                extraction_options=extraction,
            )
        if pairs is None:
            pycolmap.match_exhaustive(database, matching_options=matching)
            return
        listed = pycolmap.ImportedPairingOptions()
        listed.match_list_path = database.with_suffix(".txt")
        text = "".join(f"{first} {second}\n" for first, second in pairs)
        listed.match_list_path.write_text(text, encoding="utf-8")
        pycolmap.match_image_pairs(database, matching_options=matching, pairing_options=listed)


def map_matches(folder: Path, database: Path, *, at_once: bool = False, threads: int = -1) -> MapperBaseline:
    """Run one of COLMAP's mappers on the photographs of a database and return its largest model.

    Args:
        folder: folder of the photographs.
        database: file of `match_photographs`, which is not changed.
        at_once: whether all photographs are oriented together, by the global mapper, instead of one by one.
        threads: threads of COLMAP; -1 uses all cores.

    Raises:
        BackendError: pycolmap is missing, or finds no model.
    """
    pycolmap = load_pycolmap()
    begun = time.perf_counter()
    with scratch_folder() as work, _reported(pycolmap):
        own = work / "scene.db"
        shutil.copyfile(database, own)
        mapping = pycolmap.global_mapping if at_once else pycolmap.incremental_mapping
        pipeline = pycolmap.GlobalPipelineOptions() if at_once else pycolmap.IncrementalPipelineOptions()
        pipeline.num_threads = threads
        models = mapping(own, folder, work, pipeline)
        if not models:
            raise BackendError("COLMAP's mapper found no model: too few matches between the photographs")
        best = max(models.values(), key=lambda scene: scene.num_reg_images())
        (work / "best").mkdir()
        best.write_binary(str(work / "best"))
        network, estimate = read_model(work / "best")
        with pycolmap.Database.open(str(own)) as opened:
            total = int(opened.num_images())
    seen = network.image_points
    squares = []
    for i, rows in enumerate(rows_of(seen.image, len(network.images))):
        camera = estimate.cameras[network.camera[i]]
        xy = project(camera, estimate.position[i], estimate.rotation[i], estimate.points[seen.point[rows]])
        squares.append(((xy - seen.xy[rows]) ** 2).ravel())
    rms_px = float(np.sqrt(np.nanmean(np.concatenate(squares))))
    return MapperBaseline(network, estimate, total, rms_px, time.perf_counter() - begun)


@contextmanager
def _reported(pycolmap: Any) -> Iterator[None]:
    """Silence COLMAP, seed its random numbers, and raise its errors as `BackendError`."""
    try:
        with quiet(pycolmap):
            pycolmap.set_random_seed(RANDOM_SEED)
            yield
    except (RuntimeError, ValueError, OSError) as error:
        raise BackendError(f"COLMAP's mapper failed: {one_line(error)}") from error


def sensor_width_mm(make: str, model: str) -> float | None:
    """Return the width of a camera's sensor, mm; None if COLMAP does not know the camera.

    Args:
        make: maker as in the EXIF data.
        model: model as in the EXIF data.

    Raises:
        BackendError: pycolmap is missing.
    """
    pycolmap = load_pycolmap()
    exif = Image.Exif()
    exif[ExifTags.Base.Make], exif[ExifTags.Base.Model] = make, model
    exif[ExifTags.IFD.Exif] = {ExifTags.Base.FocalLength: IFDRational(FOCAL_MM, 1)}
    with scratch_folder() as folder:
        path = folder / "camera.jpg"
        Image.new("L", SIDE_PX).save(path, exif=exif)
        with quiet(pycolmap):
            camera = pycolmap.infer_camera_from_image(str(path))
    if not camera.has_prior_focal_length:
        return None
    return FOCAL_MM * max(SIDE_PX) / float(camera.mean_focal_length())
