"""Tests of the given values of a survey against the image points alone."""
