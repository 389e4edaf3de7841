"""Given values: judged against the free network of the image points before they are used.

`judge_given` of `judge` judges all of them: control and projection centres (`groups`, `points`, `names`), the
scales of these and of bars (`scales`), all other survey observations (`tables`) and the mounts of rigs
(`mounts`). `free_network` is the reference of each, and `values` are the statistics of all.
"""
