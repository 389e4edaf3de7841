"""Least squares fits and centroids of single targets, compiled; models in `blurred_ellipse` and `corner`."""
