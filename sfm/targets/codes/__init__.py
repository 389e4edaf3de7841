"""Codes of targets: `families` lists them, `rings` and `tags` know their patterns and read them."""
