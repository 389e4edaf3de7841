"""Space resection: the exterior orientation of one photograph from known object points, one method a file.

All methods take tangents u = -U/W, v = -V/W of the measured rays (`sfm.camera.tangents_from_pixel`), the DLT
image coordinates in mm, and answer in the frame of the object points.

- `ransac.resect_robust`: begin here; from four points on, whatever part of them is wrong.
- `fischler_bolles.resect_fischler_bolles` (P3P), `p4p.resect_p4p` (points of a plane),
  `zeng_wang.resect_zeng_wang`, `rampal.resect_rampal`: closed, without approximate values.
- `church.resect_church`: three points and an approximate position.
- `dlt.resect_dlt`: with the interior orientation, from six points on.
- `least_squares.resect_least_squares`: the adjustment, with dispersion matrix and history.
- `by_method.resect`: any of them by its name, and all of them side by side.
- `candidates.choose_by_line`, `critical_cylinder.cylinder_distance`: which solution is the true one, and
  whether the three points determine it well.
"""

METHODS = (
    "fischler-bolles",
    "p4p",
    "church",
    "zeng-wang",
    "rampal",
    "dlt",
    "robust",
    "least-squares",
)
"""The methods by their names, in the order in which they are shown side by side."""
