"""Points of many photographs at once.

- `correspondence.match_targets`: unnamed targets of oriented photographs; `evidence`: its compiled part.
- `feature_tracks.find_tie_points`: points of natural texture of photographs of unknown orientation.
- `overlap.overlapping_pairs`: which photographs have enough in common to be matched.
- `interest.foerstner_points`: points at which matching is precise.
"""
