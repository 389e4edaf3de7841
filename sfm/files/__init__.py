"""Files: read with bounds, written whole or not at all, locked, and named in plain text."""
