"""Space resection: the exterior orientation of one photograph from known object points.

All methods take tangents u = -U/W, v = -V/W of the measured rays and the object points, and answer in the
frame of these.

- `ransac.resect_robust`: begin here; from four points on, whatever part of them is wrong.
- `fischler_bolles.resect_fischler_bolles` (P3P): closed, without approximate values.
- `least_squares.resect_least_squares`: the adjustment, with dispersion matrix and history.
- `least_squares.choose_by_line`: which solution is the true one.

The other methods are in `sfm.textbook.resection`.
"""
