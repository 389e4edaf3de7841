"""Codes of targets: `plates.code_family` finds one by its name, `rings` and `tags` read theirs."""
