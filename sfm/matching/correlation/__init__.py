"""Normalised cross-correlation: where a template of one photograph is in another, to a tenth of a pixel.

- `ncc.match_ncc`: in a search window.
- `along_line.match_along_line`: along a line of the photograph, such as an epipolar line.
- `pyramid.match_pyramid`: from coarse to fine.
- `warped.match_ncc_warped`: in a window that is turned and scaled beforehand.
- `peak`, `ambiguity`: the precision of the best place, and whether the second best may be the true one.
"""
