"""Engine of the bundle adjustment.

The modules in the order of use:

- `unknowns`: order of the unknowns; `observed`: observations other than image points.
- `collinearity`: observation equation of one image point.
- `accumulate`: its sums over all image points, which form the `normals`.
- `ordering`: order in which the solvers eliminate the poses.
- `iterate`: iteration to the optimum with one of the `solvers`.
- `cofactors`: covariance at the optimum; `correlated`: the same for image points with errors in common.

The null vectors that the datum fixes are in `sfm.adjustment.datum`.
"""
