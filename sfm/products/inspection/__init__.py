"""Measurements in a finished result, as a features file requests them, and acceptance tests of the system.

`measurement.measure_result` is `kolinear measure`, `acceptance.accept_result` is `kolinear accept`.
"""
