"""Compiled code that several packages need: the options of numba, small solvers, sampling of photographs.

Begin with `compiling`: every compiled function of the project is decorated by one of its functions.
"""
