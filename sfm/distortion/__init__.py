"""Distortion models: a function each in `brown`, `forward` and `opencv`, a row each in `models`, where to begin."""
