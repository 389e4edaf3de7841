"""Sheets of coded targets for printing at true scale, see `sheet`."""
