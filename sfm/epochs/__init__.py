"""Epochs of one object: what moved between them, by how much, and what would have been seen."""
