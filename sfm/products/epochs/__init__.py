"""Epochs of one object: displacements between them, their tests, and detectable displacements.

- `analyse_epochs`: begin here; compares each epoch with the first and with the previous one.
- `epoch_differences`, then `find_displacements` and `block_motion`: the steps for two epochs.
- `adjust_together`: estimates one interior orientation for several epochs.

    >>> from sfm.products.epochs import Epoch, epoch_differences, find_displacements
    >>> # first, second: `.solution` of the results of run_survey, adjust or read_result
    >>> spring, autumn = Epoch("spring", first), Epoch("autumn", second)
    >>> found = find_displacements(epoch_differences(spring, autumn))
    >>> [name for name, stable in zip(found.differences.points, found.stable) if not stable]
    ['5']
"""

from __future__ import annotations

from sfm.runtime.public_names import public_names

__getattr__, __dir__, __all__ = public_names(__name__, __path__[0])
