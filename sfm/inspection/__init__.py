"""Measuring a finished result as a features file asks for it, and acceptance tests of the system.

`measure.measure_result` is `kolinear measure`, `acceptance.accept_result` is `kolinear accept`.
"""
