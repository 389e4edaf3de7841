"""Epochs of one object: what moved between them, by how much, and what would have been seen.

- `analyse_epochs`: begin here; each epoch against the first and the one before.
- `epoch_differences`, then `find_displacements` and `block_motion`: its steps, for two epochs.
- `adjust_together`: one interior orientation for several epochs.

    >>> from sfm.epochs import Epoch, epoch_differences, find_displacements
    >>> # first, second: what run_survey, adjust or read_result returned, as `.solution`
    >>> spring, autumn = Epoch("spring", first), Epoch("autumn", second)
    >>> found = find_displacements(epoch_differences(spring, autumn))
    >>> [name for name, stable in zip(found.differences.points, found.stable) if not stable]
    ['5']
"""

from __future__ import annotations

from sfm.runtime.installation import public_names

__getattr__, __dir__, __all__ = public_names(__name__, __path__[0])
