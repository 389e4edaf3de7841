"""What went wrong in a survey and why: lost photographs and points, wrong scales, cameras that do not fit."""
