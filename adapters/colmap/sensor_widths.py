"""Widths of camera sensors from COLMAP's list of cameras.

pycolmap gives them only through the focal length that it infers for a photograph, so it is given a small one
with the make, the model and a known focal length.
"""

from __future__ import annotations

from PIL import ExifTags, Image
from PIL.TiffImagePlugin import IFDRational

from adapters.colmap.adjuster import load_pycolmap, quiet
from sfm.files.scratch import scratch_folder

SIDE_PX = (1000, 750)
FOCAL_MM = 10


def sensor_width_mm(make: str, model: str) -> float | None:
    """Return the width of a camera's sensor, mm, None if COLMAP does not know the camera.

    Args:
        make: maker as EXIF data have it.
        model: model as EXIF data have it.

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
