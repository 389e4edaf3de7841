"""Photographs as untrusted files: `reading` (pixels), `exif` (camera, time, satellite position)."""
