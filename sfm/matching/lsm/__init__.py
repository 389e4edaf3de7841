"""Least squares matching: where a patch of one photograph is in another, to a hundredth of a pixel.

- `two_photo.match_lsm`: two photographs, with 2, 6 or 8 geometric and 2 radiometric parameters.
- `patch_equations`: resampling, the transformation of a patch and its normal equations.
- `surface_planes`: on which planes object points are, and windows as large as the surface is plane over.
- `coverage`: where object points are seen, and windows that do not overlap.
"""
