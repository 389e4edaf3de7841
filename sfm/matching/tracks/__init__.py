"""Points of many photographs at once.

- `correspondence.match_targets`: unnamed targets of oriented photographs; `evidence`: its compiled part.
- `feature_tracks.find_tie_points`: points of natural texture of photographs of unknown orientation.
- `natural_points.natural_points`: what one photograph shows alone, to be kept and linked.
- `overlap.overlapping_pairs`: which photographs have enough in common to be matched.
- `interest.foerstner_points`: points at which matching is precise.
"""
