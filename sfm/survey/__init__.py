"""The stages of a survey, in the order in which `sfm.pipeline` calls them; begin there.

`inputs` reads all inputs of a survey once. `measuring` measures the photographs. Then follow
`target_network`,
`orientation`, `correspondences`, `adjusting` and `assembly`.
"""
