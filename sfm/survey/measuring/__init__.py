"""Measurements in the photographs of a survey, targets or natural texture, and their store."""
