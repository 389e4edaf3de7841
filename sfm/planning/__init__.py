"""Planning: what a network must be like before anything is photographed.

- `target_size.target_size`: how large targets must be.
"""
