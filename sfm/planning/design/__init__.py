"""Stations that a designer chooses: candidates, the choice one by one, exchanges."""
