"""Given values: judged against the free network of the image points before they are used.

`judge` judges control, bars and projection centres, `mounts` the mounts of rigs, `tables` all other survey
observations. `free_network` is the reference of each, and `values` are the statistics of all. `points`,
`names` and `scales` are what points and lengths may have wrong, `groups` the given points of a kind.
"""
