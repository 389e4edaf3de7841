"""Many surveys in one go; begin with `run.run_batch`, which hands single surveys to workers (`job`)."""
