"""A model of another program made better: its key points measured anew, its targets added, adjusted again."""
