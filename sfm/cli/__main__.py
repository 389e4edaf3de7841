"""Runs kolinear as `python -m sfm.cli`."""

from sfm.cli import main

main()
