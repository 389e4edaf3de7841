"""The running program: progress, engines of a batch, unforeseen faults, and the installation."""
