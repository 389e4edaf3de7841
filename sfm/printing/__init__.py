"""Sheets of coded targets to be printed in true scale, see `sheet`."""
