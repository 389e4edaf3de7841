"""Findings of a result: every number of the reports, computed once.

Start with `findings_of` in `survey_remarks`: it returns what all renderers print, with the remarks. Each
other module answers one question. `checks`: how good are the observations, and how precise the unknowns?
`bundle_statistics`: what is the geometry of the network, and how well does it fit the given values?
`calibrated_cameras`: how are the cameras calibrated and mounted? `camera_remarks`: what is remarkable about
them? `protocol`: what do the protocols of other programs state?
"""
