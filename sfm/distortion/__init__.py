"""Distortion models: a function each in `brown` and `opencv`; begin with the registry, `models`."""
