"""The verdict on a survey, and what it is judged by."""
