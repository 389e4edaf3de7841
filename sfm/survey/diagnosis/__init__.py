"""Diagnosis of a survey: lost photographs and points, wrong scales, cameras that do not fit."""
