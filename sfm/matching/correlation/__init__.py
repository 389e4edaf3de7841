"""Normalised cross-correlation: where a template of one photograph is in another, to a tenth of a pixel.

- `ncc.match_ncc`: in a search window.
- `warped.match_ncc_warped`: in a window that is turned and scaled beforehand.
- `peak`, `ambiguity`: the precision of the best place, and whether the second best may be the true one.
"""
