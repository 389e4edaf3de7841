"""Best-fit shapes by orthogonal distances; start with `fit.fit_shape`."""
