"""The stages of a survey, in the order in which `sfm.pipeline` calls them; begin there.

`inputs` reads what a survey is given, once; `measuring` measures the photographs; then come `target_network`,
`orientation`, `correspondences`, `adjusting` and `assembly`.
"""
