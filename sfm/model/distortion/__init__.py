"""Distortion models: `models` lists them (begin there); `brown`, `radial` and `opencv` contain them."""
