"""Compiled templates kept on disk, beside the sources as Python's own: compiling takes half a second a run.

Jinja knows a template by its text; what it makes of it depends on the filters, too, some of which it computes
ahead: they are kept for all sources that the module of the filters depends on, and for the release of Jinja.
"""

from __future__ import annotations

import os
import pickle
import sys
from contextlib import suppress
from importlib.metadata import version
from pathlib import Path

from jinja2.bccache import Bucket, FileSystemBytecodeCache

from sfm.kernels.sources import source_hash

KEPT = Path(__file__).parent / "__pycache__"
HASH_DIGITS = 16


def template_cache(module: str) -> TemplateCache | None:
    """Return where the templates of a module are kept; None if nothing can or shall be written there.

    Args:
        module: that makes the environment of the templates.
    """
    sources = source_hash(module)
    if sources is None or sys.dont_write_bytecode or not os.access(KEPT, os.W_OK):
        return None
    release = f"{module}-{version('jinja2')}-{sources[:HASH_DIGITS]}"
    for old in KEPT.glob(f"{module}-*.template"):
        if not old.name.startswith(release):
            with suppress(OSError):
                old.unlink()
    return TemplateCache(str(KEPT), f"{release}-%s.template")


class TemplateCache(FileSystemBytecodeCache):
    """Kept templates; one that cannot be read is compiled again, one that cannot be written is not kept."""

    def load_bytecode(self, bucket: Bucket) -> None:
        """Fill a bucket with what is kept of its template."""
        try:
            super().load_bytecode(bucket)
        except (OSError, EOFError, ValueError, TypeError, pickle.UnpicklingError):
            bucket.reset()

    def dump_bytecode(self, bucket: Bucket) -> None:
        """Keep what a bucket holds."""
        with suppress(OSError):
            super().dump_bytecode(bucket)
