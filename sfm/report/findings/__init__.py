"""Findings of a result: every number of the reports, computed once.

`findings_of` in `survey_remarks` is where to begin: it returns what all renderers print, with the remarks.
The other modules each answer one question: how good the observations are and how precise the unknowns
(`checks`), how the network lies and how well it meets what was given (`bundle_statistics`), how cameras are
calibrated and mounted (`calibrated_cameras`), what to remark on them (`camera_remarks`), and what protocols
of other programs state (`protocol`).
"""
