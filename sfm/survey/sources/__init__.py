"""Where the image points of a survey come from: a file for each source.

Its row is in `sfm.survey.inputs.sources`.
"""
