"""How good an adjustment is: gross errors, reliability, tests, variance components, rank, correlations.

Begin with `statistics`: Baarda's w, Pope's tau, the global test, minimal detectable errors.
"""
