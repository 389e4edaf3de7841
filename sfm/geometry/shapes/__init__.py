"""Best-fit shapes by orthogonal distances: `fit.fit_shape` is the entrance."""
