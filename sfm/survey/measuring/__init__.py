"""What is measured in the photographs of a survey, side by side: targets or natural texture; and its store."""
