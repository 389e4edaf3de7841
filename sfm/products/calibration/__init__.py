"""Calibration: how well a camera is known, where it is, and what would improve it."""
