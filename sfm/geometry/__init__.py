"""Use of coordinates: distances and angles, best-fit shapes, alignment, tolerances, acceptance.

Every quantity keeps its derivatives by the coordinates of the points, so that its covariance, and that of any
two quantities together, follows from the covariance of the network.
"""
