"""Space resection by further methods. `by_method.resect` calls any method by its name.

- `p4p`: coplanar points, closed form, without approximate values.
- `zeng_wang`: the methods of Zeng and Wang and of Rampal, without approximate values.
- `church`: three points and an approximate position.
- `dlt`: six or more points, together with the interior orientation.
- `unknown_noise`: robust resection that finds its tolerance from the points.
- `by_method.cylinder_distance`: how well three points determine the position.
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
"""Names of the methods, in the order in which comparisons list them."""
