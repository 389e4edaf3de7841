"""The adjustment of a survey: its datum, its free parameters, and repetition until nothing is removed."""
