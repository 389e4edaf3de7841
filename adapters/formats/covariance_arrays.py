"""covariances.npz of a result: those of each exterior and each interior orientation as arrays.

    image_names (m,), exterior (m, 6, 6)       X0, Y0, Z0 (object unit), omega, phi, kappa (rad)
    camera_names (a,), interior_0 (f, f) ...   of the free parameters of each camera

Source: NumPy's .npz; the arrays are described in the README.
"""

from __future__ import annotations

import zipfile
from pathlib import Path

import numpy as np

from sfm.conventions import FloatArray
from sfm.errors import SurveyFileError
from sfm.files.result_tables import COVARIANCES
from sfm.solution import Solution

MAX_BYTES = 2**31  # of the file unpacked


def read_covariances(folder: Path, result: Solution) -> tuple[FloatArray | None, tuple[FloatArray, ...]]:
    """Return the covariances of the exterior (m, 6, 6) and of each interior orientation, None and () without.

    Args:
        folder: of the result; the file may be missing.
        result: that the tables beside it say.

    Raises:
        SurveyFileError: the file is damaged or belongs to other tables.
    """
    path = folder / COVARIANCES
    if not path.is_file():
        return None, ()
    images, cameras = result.network.images, result.estimate.cameras
    free = [int(camera.free.sum()) for camera in cameras]
    try:
        with zipfile.ZipFile(path) as archive:
            if sum(entry.file_size for entry in archive.infolist()) > MAX_BYTES:
                raise SurveyFileError(f"{path}: arrays of more than {MAX_BYTES} bytes, no more are read")
        with np.load(path, allow_pickle=False) as arrays:
            known = {name: arrays[name] for name in arrays.files if name not in ("points", "point_names")}
    except (OSError, ValueError, EOFError, SyntaxError, KeyError, zipfile.BadZipFile) as error:
        raise SurveyFileError(f"{path}: is no array of NumPy") from error
    exterior = known.get("exterior")
    interior = tuple(known.get(f"interior_{k}", np.zeros((0, 0))) for k in range(len(cameras)))
    fits = exterior is None or (
        tuple(known.get("image_names", ())) == images and exterior.shape == (len(images), 6, 6)
    )
    fits &= all(Q.shape in ((f, f), (0, 0)) for Q, f in zip(interior, free, strict=True))
    matrices = interior if exterior is None else (exterior, *interior)
    if not (fits and all(Q.dtype == np.float64 for Q in matrices)):
        raise SurveyFileError(
            f"{path}: covariances of other photographs or cameras than the tables beside it"
        )
    return exterior, interior
