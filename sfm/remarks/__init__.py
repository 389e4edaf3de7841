"""What the program says of a result: remarks, the catalogue of their kinds, the verdict."""
