"""How a network is adjusted; in the order of use.

`unknowns` lays out what is solved for, `observed` what was observed beside image points; `collinearity` is
the formula of one image point, `accumulate` sums it into `normals` in the order of `ordering`; `iterate` goes
to the optimum with one of `solvers`; `cofactors` are the covariance there, `correlated` that of image points
with errors in common. The null vectors that the datum fixes are in `sfm.adjustment.datum`.
"""
