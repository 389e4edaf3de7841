"""What is wrong with the input: contradictions, repetitions and missing settings."""
