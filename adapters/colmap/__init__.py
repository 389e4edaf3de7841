"""COLMAP: its adjuster and mapper run on Kolinear's networks; its models and databases are read and written.

COLMAP's pixel frame has its origin in a corner. The half pixel between the frames is added here and nowhere
else.
"""
