"""What a photograph of a plan shows: format, incidence, hidden points, depth of field, size of targets."""
