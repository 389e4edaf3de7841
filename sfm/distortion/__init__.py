"""Distortion models: functions in `brown`, `radial` and `opencv`, a row each in `models`: begin there."""
