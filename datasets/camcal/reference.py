"""Writes the reference surveys of camcal into a folder, with the image points of PhotoModeler's export.

python datasets/camcal/reference.py FOLDER_OF_THE_EXPORT OUT
kolinear adjust OUT/reference_fixed.toml
"""

from __future__ import annotations

import csv
import shutil
import sys
from pathlib import Path

from adapters.formats.photomodeler import read_photomodeler

HERE = Path(__file__).parent
SURVEYS = ("reference_fixed.toml", "reference_free.toml")


def prepare(export: Path, out: Path) -> None:
    """Write image_points.csv, control.csv and the survey files into `out`.

    Args:
        export: folder with camcal-pmexport.txt and camcal-fixed.txt.
        out: folder to create.
    """
    network, _ = read_photomodeler(export / "camcal-pmexport.txt", control=export / "camcal-fixed.txt")
    out.mkdir(parents=True, exist_ok=True)
    seen = network.image_points
    with (out / "image_points.csv").open("w", newline="", encoding="utf-8") as file:
        table = csv.writer(file)
        table.writerow(["image", "point", "x_px", "y_px"])
        for image, point, (x, y) in zip(seen.image, seen.point, seen.xy.tolist(), strict=True):
            table.writerow([Path(network.images[image]).name, network.points[point], x, y])
    with (out / "control.csv").open("w", newline="", encoding="utf-8") as file:
        table = csv.writer(file)
        table.writerow(["id", "X", "Y", "Z"])
        for point, xyz in zip(network.control.point, network.control.xyz.tolist(), strict=True):
            table.writerow([network.points[point], *xyz])
    for name in SURVEYS:
        shutil.copy(HERE / name, out / name)


if __name__ == "__main__":
    if len(sys.argv) != 3:
        sys.exit(__doc__)
    prepare(Path(sys.argv[1]), Path(sys.argv[2]))
