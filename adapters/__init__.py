"""Adapters to other programs: their file formats, COLMAP, and the workers of a cluster.

- `formats.registry`: every format by name; to add one, write its module and one row there.
- `colmap`: the only package that imports pycolmap.
- `dask_cluster`: runs the surveys of a batch on the workers of a Dask cluster.
"""
