"""The running program: progress, engines of a batch, faults nobody has foreseen, and where it is installed."""
