"""Pictures: `plots` of an adjustment, `overlays` on photographs, `patches` of matched points."""
