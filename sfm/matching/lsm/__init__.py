"""Least squares matching: where a patch of one photograph is in another, to a hundredth of a pixel.

- `two_photo.match_lsm`: two photographs, with 2, 6 or 8 geometric and 2 radiometric parameters.
- `window`, `warp`, `patch_equations`, `patch_precision`: resampling, the transformation of a patch, its
  normal equations and its precision; `projected_points`, `surface_planes`: where object points are seen,
  and on which planes; `plane_windows`: windows as large as the surface is plane over; `coverage`: windows
  that do not overlap, and how large they are.
"""
