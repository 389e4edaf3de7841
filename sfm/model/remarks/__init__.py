"""Statements about a result: remarks, the catalogue of their kinds, and the verdict."""
