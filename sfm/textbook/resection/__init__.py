"""Space resection by other methods, one a file, and `by_method.resect`: any method by its name.

- `p4p` (points of a plane), `zeng_wang`, `rampal`: closed, without approximate values.
- `church`: three points and an approximate position.
- `dlt`: with the interior orientation, from six points on.
- `unknown_noise`: the tolerance of random sample consensus found from the points.
- `critical_cylinder`: whether three points determine the position well.
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
