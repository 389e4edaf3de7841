"""Findings of a result: every number of the reports, computed once.

`findings_of` in `findings` is where to begin: it returns what all renderers print. The other modules each
answer one question: how good the observations are (`checks`, `bundle_statistics`, `protocol`), how the
network lies (`geometry`), what was given (`given_residuals`), how precise the unknowns are (`precision`,
`interior_parameters`, `calibrated_cameras`, `rigs`), and what to remark on it (`survey_remarks`,
`camera_remarks`, `given_remarks`, `sharpness`).
"""
