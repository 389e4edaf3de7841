"""Points in many photographs at once.

- `correspondence.match_targets`: unlabelled targets of oriented photographs; `evidence`: its compiled part.
- `feature_tracks.find_tie_points`: points of natural texture in photographs of unknown orientation.
- `overlap.overlapping_pairs`: pairs of photographs that overlap enough to be matched; among many photographs,
  `retrieval.similar_photographs` finds which to compare.
- `interest.natural_points`: the natural points of a single photograph. They are kept, linked with those of
  others, and moved to points at which matching is precise (`interest.foerstner_points`).
"""
