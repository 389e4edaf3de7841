"""Bundle adjustment with self-calibration: begin with `solve.adjust`.

A caller needs `solve` (adjust a network), `result` (what comes back), `datum` (what decides position,
attitude and scale), `covariance` (joint covariances and change of datum of a finished adjustment) and
`separate` (points and orientations in turn). How it is computed is in `engine`, how good it is in `quality`.
"""
