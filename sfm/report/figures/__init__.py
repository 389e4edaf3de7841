"""Pictures: `plots` of an adjustment, `overlays` on photographs, `comparisons` of results."""
