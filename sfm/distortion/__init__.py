"""Distortion models: functions in `brown`, `forward` and `opencv`, a row each in `models`: begin there."""
