"""Least squares matching: where a patch of one photograph is in another, to a hundredth of a pixel.

- `two_photo.match_lsm`: two photographs, with 2, 6 or 8 geometric and 2 radiometric parameters.
- `multi_photo.match_multi`: one point in many oriented photographs at once.
- `window`, `warp`, `patch_equations`, `patch_precision`: resampling, the transformation of a patch, its
  normal equations and its precision; `projected_points`: where object points are seen.
"""
