"""A draft of a survey file from a folder of photographs, for people who have not written one yet.

- `draft.draft_survey`: begin here; finds cameras and targets, and writes the commented text of the file.
- `camera_groups.group_photographs`: groups the photographs by camera, and collects the camera data.
- `target_trial.try_targets`: finds the kind of targets by measuring a few photographs.
"""
