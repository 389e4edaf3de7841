"""Space resection: the exterior orientation of one photograph from known object points.

All methods take the tangents u = -U/W, v = -V/W of the measured rays and the object points. Results are in
the frame of the object points.

- `ransac.resect_robust`: start here; for four or more points, any of which may be wrong.
- `fischler_bolles.resect_fischler_bolles` (P3P): closed form, without approximate values.
- `least_squares.resect_least_squares`: the adjustment, with covariance and history.
- `least_squares.choose_by_line`: selects the true solution.

Other methods are in `sfm.textbook.resection`.
"""
