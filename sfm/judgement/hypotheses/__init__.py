"""Finds wrong assumptions of a survey by alternative hypotheses, which free parameters and are compared."""
