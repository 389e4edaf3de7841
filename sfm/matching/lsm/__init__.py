"""Least squares matching: locate a patch of one photograph in another to a hundredth of a pixel.

- `two_photo.match_lsm`: two photographs, with 2, 6 or 8 geometric and 2 radiometric parameters.
- `patch_equations`: resampling, the transformation of a patch and its normal equations.
- `surface_planes`: local planes of the surface, and windows as large as the surface is plane.
- `window_slopes`: one slope of the plane of a window for all its photographs.
- `coverage`: projected object points, and windows that do not overlap.
"""
