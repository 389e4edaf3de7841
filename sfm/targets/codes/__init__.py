"""Codes of targets: `plates.code_family` finds a family by name; `rings` and `tags` read their codes."""
