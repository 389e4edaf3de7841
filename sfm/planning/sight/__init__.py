"""Visibility in a photograph of a plan: format, incidence, hidden points, depth of field, size of targets."""

MIN_PIXELS = 7.0
"""on a target, as document 000 takes it; the measurement itself begins at 3"""
