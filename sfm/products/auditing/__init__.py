"""What the image points of a model say of it: whether it is determined, how well, and what is wrong."""
