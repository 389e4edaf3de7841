"""Adapters to the outside: the file formats of other programs, COLMAP, and the workers of a cluster.

- `formats.registry`: every format by its name; to add one, write its module and one row there.
- `colmap`: the only importer of pycolmap.
- `dask_cluster`: surveys of a batch on the workers of a Dask cluster.
"""
