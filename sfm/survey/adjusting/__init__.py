"""The adjustment of a survey: its datum, what is free, and what leaves until nothing leaves any more."""
