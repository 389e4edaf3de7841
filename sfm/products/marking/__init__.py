"""Marking in the browser: image points that a person measures, with guidance by the orientation so far."""
