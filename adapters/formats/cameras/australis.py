"""Camera parameters of Australis (Photometrix), the table of its bundle adjustment results.

    Results for Camera 1   NAME
    H  648  0.007          width, px, and width of a pixel, mm
    V  494  0.007          height, px, and height of a pixel, mm
    C  8.0000  0.30937  8.3094  1.0e+003  6.782e-003 (mm)
                           initial value, adjustment, final value, initial and final standard deviation

and in the same form XP, YP, K1, K2, K3, P1, P2, B1, B2. These are the parameters of `brown_affine`, which
corrects the measured point in mm. Australis adds b1 x + b2 y to the corrections instead, which differs by b1
times the distortion, a few thousandths of a px. Correlations are not in the file, so its standard deviations
do not give a covariance.

Source: Australis bundle adjustment results as printed for the cameras of WASP-LT (Rochester Institute of
Technology, 2006); Fraser (1997), Digital camera self-calibration, ISPRS J. 52(4), for the parameters.
"""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from adapters.reading.text_lines import Lines
from sfm.files.plain_text import MAX_PIXEL_MM, MAX_SIDE_PX, as_plain, is_name
from sfm.model.camera import camera_from_values
from sfm.model.camera_file import CameraFile
from sfm.model.errors import SurveyFileError

PARAMETERS = {
    **{"C": "c", "XP": "x0", "YP": "y0"},
    **{name: name for name in ("K1", "K2", "K3", "P1", "P2")},
    **{"B1": "b1", "B2": "b2"},
}
FINAL = 2  # place of the final value in a row of numbers
CAMERA = re.compile(r"\s*Results for Camera\s+\d+\s*(.*)", re.IGNORECASE)
MAX_LINES = 100_000


def read_australis(path: Path) -> CameraFile:
    """Read the cameras of a file, with final values.

    Raises:
        SurveyFileError: no camera, or one without size, pixel or principal distance.
    """
    text = Lines.of(path)
    entries: list[tuple[str, dict[str, float], dict[str, tuple[int, float]]]] = []
    while (line := text.maybe_line()) is not None and text.number < MAX_LINES:
        titled, words = CAMERA.match(line), line.replace("(mm)", " ").split()
        if titled:
            name = re.sub(r"\s+Lens\s*$", "", titled[1].strip())
            entries.append((name if is_name(name) else f"camera {len(entries) + 1}", {}, {}))
        elif words and words[0] in ("H", "V") and len(words) == 3:
            if not entries:
                entries.append((path.stem, {}, {}))
            side = text.whole_of(words[1], 1, MAX_SIDE_PX, "a side of the photographs")
            pixel = text.number_of(words[2])
            if not 0 < pixel <= MAX_PIXEL_MM:
                raise text.error(f"pixels of {pixel:g} mm, needed 0 to {MAX_PIXEL_MM:g}")
            entries[-1][2][words[0]] = side, pixel
        elif words and words[0] in PARAMETERS and len(words) == 6 and entries:
            entries[-1][1][PARAMETERS[words[0]]] = text.number_of(words[1 + FINAL])
    if not entries:
        raise SurveyFileError(f"{path}: no results for a camera are in this file of Australis")
    cameras = []
    for name, values, sides in entries:
        if len(sides) != 2 or not values.get("c", 0.0) > 0:
            what = "principal distance C" if len(sides) == 2 else "sensor size and pixel size (H and V)"
            raise SurveyFileError(f"{path}: camera {as_plain(name)}: {what} is missing")
        (width, sx), (height, sy) = sides["H"], sides["V"]
        cameras.append(
            camera_from_values(
                name,
                "brown_affine",
                (width, height),
                (sx, sy),
                c_mm=values["c"],
                values=tuple(values.items()),
            )
        )
    return CameraFile(path.name, tuple(cameras), (None,) * len(cameras))


def write_australis(path: Path, file: CameraFile) -> str:
    """Return the text of cameras in model brown_affine, or brown without affinity.

    Standard deviations are written where they are known.
    """
    lines = ["Australis Bundle Adjustment Results: Camera Parameters", ""]
    for k, (camera, Q) in enumerate(zip(file.cameras, file.covariance, strict=True), 1):
        sigma = np.zeros(len(camera.names)) if Q is None else np.sqrt(np.diagonal(Q))
        lines += [f"Results for Camera {k}   {camera.name}", "", "Sensor Size   Pixel Size (mm)"]
        for axis, side, pixel in zip("HV", camera.size_px, camera.pixel_mm.tolist(), strict=True):
            lines.append(f"{axis}  {side}  {pixel!r}")
        lines += ["", "Camera    Initial  Total       Final  Initial     Final"]
        lines.append("Variable  Value    Adjustment  Value  Std. Error  Std. Error")
        for ours, deviation in zip(camera.names, sigma.tolist(), strict=True):
            name = next(theirs for theirs, of in PARAMETERS.items() if of == ours)
            value, unit = camera.value(ours), " (mm)" if name in ("C", "XP", "YP") else ""
            lines.append(f"{name:<4} {value!r}  0.0  {value!r}  {deviation!r}  {deviation!r}{unit}")
        lines.append("")
    return "\n".join(lines)
