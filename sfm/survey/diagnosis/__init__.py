"""Diagnosis of a survey: lost photographs, codes not found or contradicting, cameras that do not fit."""
