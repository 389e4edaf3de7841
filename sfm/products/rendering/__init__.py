"""Synthetic photographs of scenes with known truth: begin with `render`; `scene` lists what can be drawn."""
