"""Photographs as untrusted files: `reading` (pixels) and `exif` (camera, time, satellite position)."""
