"""Solvers of the reduced normal equations, with one protocol; start with `protocol`, then `choice`."""
