"""Batches of surveys; begin with `run.run_batch`, which passes single surveys to workers (`job`)."""
