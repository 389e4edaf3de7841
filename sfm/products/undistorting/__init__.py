"""Photographs without distortion, and rectified pairs: what they show (`views`), and how they are drawn."""
