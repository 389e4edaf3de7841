"""Photographs as files: `reading` (pixels), `exif`, `satellite_positions`, `file_checks` (untrusted)."""
