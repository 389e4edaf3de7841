"""The types of the field: frames, cameras, measurements, values, observations, results and remarks."""
