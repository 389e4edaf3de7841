"""Refinement of another program's model: key points measured again, targets added, everything adjusted."""
