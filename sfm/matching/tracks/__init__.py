"""Points in many photographs at once.

- `correspondence.match_targets`: unlabelled targets of oriented photographs; `evidence`: its compiled part.
- `feature_tracks.find_tie_points`: points of natural texture in photographs of unknown orientation.
- `features.overlapping_pairs`: pairs of photographs that overlap enough to be matched.
- `interest.natural_points`: the natural points of a single photograph. They are kept, linked with those of
  others, and moved to points at which matching is precise (`interest.foerstner_points`).
"""
