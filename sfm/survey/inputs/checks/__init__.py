"""Checks of the input: contradictions, repetitions and missing settings."""
