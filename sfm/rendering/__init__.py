"""Synthetic photographs of scenes with known truth; begin with `render`, what can be drawn is in `scene`."""
