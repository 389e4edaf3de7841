"""Georeferencing: one photograph of a flat object in the frame of its control points."""
