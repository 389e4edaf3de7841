"""Photographs without distortion, and rectified pairs: `views` says what they show, `photographs` draws them."""
