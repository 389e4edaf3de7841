"""Quality of an adjustment: gross errors, reliability, tests, variance components, rank, correlations.

Start with `statistics`: Baarda's w, Pope's tau, the global test, minimal detectable errors.
"""
