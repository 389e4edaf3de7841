"""The methods of resection by their names, in the order in which they are shown side by side."""

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
