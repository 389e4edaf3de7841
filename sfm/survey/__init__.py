"""The stages of a survey, in the order in which `sfm.pipeline` calls them; begin there.

`inputs` reads all inputs of a survey once. `sources` measures its image points, before and after
`orientation`. Then follow `adjusting` and `assembly`.
"""
