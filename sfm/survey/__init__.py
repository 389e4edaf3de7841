"""The stages of a survey, in the order in which `sfm.pipeline` calls them; begin there.

`inputs` reads what a survey is given, once; `network` (targets) and `tie_points` (texture) measure the
photographs; then come `orientation`, `correspondences`, `solution`, `comparison` and `assembly`.
"""
