"""Given values: judged against the free network of the image points before they are used.

`judge` judges control, bars, projection centres and mounts, `tables` all other survey observations. `values`
are the statistics of both, `free_network` the reference, `points`, `names` and `scales` what points and
lengths may have wrong.
"""
