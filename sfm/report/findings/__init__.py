"""Findings of a result: every number of the reports, computed once.

`findings_of` in `findings` is where to begin: it returns what all renderers print. The other modules each
answer one question: how good the observations are (`checks`, `statistics`), how the network lies
(`geometry`), what was given (`given`), how precise the unknowns are (`precision`, `interior`), what was left
out (`rejected`), whether the other adjuster agrees (`comparison`), and what to think of it (`verdict`).
"""
