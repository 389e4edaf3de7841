"""Kinds of observations beside image points, one in each module; `kind` has what they share."""
