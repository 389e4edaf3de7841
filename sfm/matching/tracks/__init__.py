"""Points of many photographs at once.

- `correspondence.match_targets`: unnamed targets of oriented photographs; `evidence`: its compiled part.
- `feature_tracks.find_tie_points`: points of natural texture of photographs of unknown orientation.
- `features.overlapping_pairs`: which photographs have enough in common to be matched.
- `interest.natural_points`: what one photograph shows alone, to be kept and linked, at points at which
  matching is precise (`interest.foerstner_points`).
"""
