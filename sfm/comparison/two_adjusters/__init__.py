"""This adjuster and another one: on the network of a survey, and on random networks."""
