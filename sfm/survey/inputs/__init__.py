"""Input of a survey: its file or settings from Python, its tables and its photographs, each read once.

Begin with `survey` (`Survey`, `read_survey`). `settings` declares the keys of the file, and `given` reads its
tables.
"""
