"""Photographs as untrusted files: `reading` (pixels) and `exif` (camera, time, satellite position).

Kinds of files are modules: `tiff_files`, `camera_files` (HEIF and raw) and `video_files`.
"""
