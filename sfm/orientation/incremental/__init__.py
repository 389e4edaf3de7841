"""Orientation of a set of photographs: a pair to start from, then one photograph after the other."""
