"""Input of a survey: its file or Python's settings, its tables and its photographs, each read once.

Begin with `survey` (`Survey`, `read_survey`); `settings` are the words of the file, `given` its tables.
"""
