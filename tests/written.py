"""What the folder of a result may hold."""

from __future__ import annotations

from sfm.files.covariance_file import ARRAYS, NAME, POINTS_NAME
from sfm.files.open_folders import MANIFEST
from sfm.files.result_tables import MOMENTS, MOUNTS, TABLES

WRITTEN = (
    *(table.file for table in TABLES),
    *(MOUNTS, MOMENTS, NAME, POINTS_NAME, ARRAYS, MANIFEST),
    *("summary.json", "report.txt", "report.html", "points.ply", "log.jsonl"),
    *("colmap", "overlays", "pictures", "plots"),
)
