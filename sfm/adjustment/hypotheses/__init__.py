"""Which assumption of a survey is wrong: alternatives that free something, tested against one another."""
