"""Files: read with limits, written completely or not at all, locked, and with names in plain text."""
