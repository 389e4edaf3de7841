"""Incremental orientation of a set of photographs: a starting pair, then the other photographs in turn."""
