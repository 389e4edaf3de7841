"""Space resection by other methods, and `by_method.resect`: any method by its name.

- `p4p` (points of a plane), `zeng_wang` (and Rampal's method): closed, without approximate values.
- `church`: three points and an approximate position.
- `dlt`: with the interior orientation, from six points on.
- `unknown_noise`: the tolerance of random sample consensus found from the points.
- `by_method.cylinder_distance`: whether three points determine the position well.
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
