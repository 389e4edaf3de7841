"""Comparison of this adjuster with another one, on the network of a survey and on random networks."""
