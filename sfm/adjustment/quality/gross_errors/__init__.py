"""Gross errors in the observations: robust estimation and rejection."""
