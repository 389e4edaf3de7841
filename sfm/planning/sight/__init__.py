"""Visibility in a photograph of a plan: format, incidence, hidden points, depth of field, size of targets."""
