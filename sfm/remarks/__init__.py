"""Statements on a result: remarks, the catalogue of their kinds, the verdict."""
