"""COLMAP: its adjuster and mapper run on networks of Kolinear, its models and databases read and written.

The origin of its pixel frame is a corner: the half pixel is added here and nowhere else.
"""
