"""What is measured in the photographs of a survey, targets or natural texture, and its store."""
