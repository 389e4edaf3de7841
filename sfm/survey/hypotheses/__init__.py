"""Which given values of a survey are wrong, by the image points alone."""
