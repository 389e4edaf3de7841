"""Gross errors among the observations: robust estimation, rejection, and rays that may be wrong."""
