"""Camera models of mrcal (.cameramodel), a Python literal.

    lensmodel       LENSMODEL_PINHOLE, _STEREOGRAPHIC, _OPENCV4, _OPENCV5, _OPENCV8, _OPENCV12
    intrinsics      fx, fy, cx, cy, coefficients in the order of OpenCV
    imagersize      width, height
    rt_cam_ref      rotation vector and translation from reference coordinates; `extrinsics` before 2.5

A stereographic projection is model `eucm` with alpha 1/2 and beta 1. Splined models and CAHVOR have no equal
here and are refused. The optimization inputs, from which mrcal computes uncertainties, are not read.

Source: mrcal 2.5, "The .cameramodel file format" and "Lens models"; Khomutenko et al. (2016), An enhanced
unified camera model, IEEE RA-L 1(1), whose alpha = 1/2, beta = 1 is r = 2 f tan(theta / 2).
"""

from __future__ import annotations

import ast
import json
import re
import warnings
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from adapters.formats.cameras.lens_terms import (
    Mounted,
    alone,
    camera_in_pixels,
    camera_of_matrix,
    coefficients_of,
    matrix_of,
    numbers_text,
)
from adapters.reading.trees import Tree, text_of
from sfm.files.plain_text import shorten
from sfm.model.camera_file import CameraFile
from sfm.model.errors import SurveyFileError

WHAT = "a camera model of mrcal"
MAX_BYTES = 50_000_000  # of which nearly all are the optimization inputs
MAX_LITERAL = 500_000  # characters besides them, of which Python parses 0.3 MB in a second; a camera has 400
OPTIMIZATION = re.compile(r"b'[^'\n]*'")  # in base 85, which has no quotes
COUNTS = {"PINHOLE": 0, "STEREOGRAPHIC": 0, "OPENCV4": 4, "OPENCV5": 5, "OPENCV8": 8, "OPENCV12": 12}
LENS = "LENSMODEL_"
STEREOGRAPHIC = (0.5, 1.0)  # alpha and beta of eucm


def read_mrcal(path: Path) -> CameraFile:
    """Read one camera; its pose belongs to the reference coordinates of its calibration and is left out.

    Raises:
        SurveyFileError: not a camera model, or a lens model that is not read.
    """
    text = OPTIMIZATION.sub("b''", text_of(path, MAX_BYTES, WHAT))
    if len(text) > MAX_LITERAL:
        raise SurveyFileError(
            f"{path}: {len(text)} characters besides the optimization inputs, {WHAT} has at most "
            f"{MAX_LITERAL}"
        )
    try:
        with warnings.catch_warnings(action="ignore"):  # of escapes in texts
            values = ast.literal_eval(text.strip())
    except SyntaxError as error:
        raise SurveyFileError(f"{path}, line {error.lineno or 1}: not {WHAT} (no Python literal)") from error
    except (ValueError, TypeError, MemoryError, RecursionError) as error:
        raise SurveyFileError(f"{path}: not {WHAT} (no Python literal)") from error
    if not isinstance(values, dict):
        raise SurveyFileError(f"{path}: not {WHAT}, no keys and values are in it")
    tree = Tree(path, {str(key): _as_text(value) for key, value in values.items()})
    lens = tree.text("lensmodel")
    kind = lens.removeprefix(LENS)
    if kind.startswith("SPLINED"):
        raise tree.error(
            f"{lens.partition('_order')[0]}: splined models are not read; mrcal-convert-lensmodel converts "
            "them"
        )
    if not lens.startswith(LENS) or kind not in COUNTS:
        raise tree.error(
            f"lensmodel {shorten(lens)}, expected one of {', '.join(LENS + name for name in COUNTS)}"
        )
    sides = tree.numbers(("imagersize",), 2)
    size = tree.side("imagersize", sides[0]), tree.side("imagersize", sides[1])
    p = tree.numbers(("intrinsics",), 4 + COUNTS[kind])
    if kind == "STEREOGRAPHIC":
        camera = camera_in_pixels(f"{path}", path.stem, "eucm", size, np.array([*p, *STEREOGRAPHIC]))
    else:
        K = np.array([[p[0], 0.0, p[2]], [0.0, p[1], p[3]], [0.0, 0.0, 1.0]])
        camera = camera_of_matrix(f"{path}", path.stem, size, K, p[4:])
    return CameraFile(path.name, (camera,), (None,))


def write_mrcal(path: Path, file: CameraFile) -> str:
    """Return the text of a file with one camera, at the origin."""
    return "\n".join(model_lines(alone(file.cameras[0]), "unknown units")) + "\n"


def model_lines(mounted: Mounted, unit: str) -> Iterator[str]:
    """Yield the lines of a camera, in the coordinates of the reference camera."""
    camera, K = mounted.camera, matrix_of(mounted.camera)
    pose = numbers_text([*Rotation.from_matrix(mounted.R).as_rotvec(), *mounted.T])
    D = [] if camera.model == "eucm" else coefficients_of(camera, fewest=4)
    lens = LENS + ("STEREOGRAPHIC" if camera.model == "eucm" else f"OPENCV{len(D)}")
    intrinsics = numbers_text([K[0, 0], K[1, 1], K[0, 2], K[1, 2], *D])
    yield f"# {json.dumps(camera.name)}, translations are in {unit}"
    yield from ("{", f"    'lensmodel':  '{lens}',", f"    'intrinsics': [ {intrinsics} ],")
    yield f"    'rt_cam_ref': [ {pose} ],"
    yield f"    'extrinsics': [ {pose} ],  # the same for mrcal before 2.5"
    yield from (f"    'imagersize': [ {camera.size_px[0]}, {camera.size_px[1]} ],", "}")


def _as_text(value: object) -> object:
    """Return numbers as texts, as the trees of other files have them."""
    if isinstance(value, list | tuple):
        return [_as_text(item) for item in value]
    return repr(value) if isinstance(value, int | float) else value
