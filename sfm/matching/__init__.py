"""Matching: the same points in several photographs, measured by their texture or found among unnamed targets.

- `conjugate.match_points`: begin here; points of one photograph in another, by correlation and least squares.
- `local_affinity`, `turned_templates`: its starts on wide baselines, by key points or by turned templates.
- `relative_blur`: which photograph is blurred more, and both brought to one blur.
- `correlation`: normalised cross-correlation in windows, along epipolar lines and in pyramids.
- `lsm`: least squares matching of two photographs, and of many tied together by their orientation.
- `tracks`: points of many photographs: unnamed targets, and natural texture.
- `epipolar.epipolar_paths`: the lines, bent by distortion, on which a point may be in another photograph.
- `normal_images.normal_images`: two photographs resampled so that these lines are their rows.
- `radiometry`: mean, contrast and histogram of patches, equalisation, brightness of one brought to another.
- `match_flags`: why matching gives no position.
"""
