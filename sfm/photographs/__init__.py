"""Photographs as files: `reading` (pixels), `exif` (camera and sensor), `file_checks` (untrusted files)."""
