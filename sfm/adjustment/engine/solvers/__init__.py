"""Solvers of the reduced normal equations behind one protocol; begin with `protocol`, then `choice`."""
