"""Orientation: from measured image points to approximate values of photographs and object points.

- `sequence.orient`: begin here; a whole network from its image points and nothing else.
- `resection`: one photograph on known points, one method a file.
- `relative.relative_orientations`: two photographs from conjugate rays alone, whatever the scene;
  `pair.orient_dependent`, `pair.orient_independent`: with the five classical parameters;
  `coplanarity.refine_coplanarity`: the adjustment below both.
- `intersection.intersect`: object points from the rays of oriented photographs.
- `absolute.orient_absolute`: a model onto control; `direct.orient_direct`: photographs onto control at once.
- `fiducials.orient_fiducials`: interior orientation of scanned photographs.
- `photo_coordinates.correct_photo_coordinates`, `photo_coordinates.photo_coordinates`: corrections for
  distortion, refraction and earth curvature, and simulated photographs.
"""
