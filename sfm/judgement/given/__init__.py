"""Given values: judged against the free network of the image points before they are used.

`judge_given` of `judge` judges all of them: control and projection centres (`groups`, `points`), the scales
of these and of bars (`scales`), all other survey observations (`tables`) and the mounts of rigs (`mounts`).
`free_network` is their reference, `values` are their statistics, and `mistakes` tries common mistakes.
"""
