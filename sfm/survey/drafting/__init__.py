"""A survey file drafted from a folder of photographs, for people who have not written one yet.

- `draft.draft_survey`: begin here; cameras, targets and remarks, and the commented text of the file.
- `camera_groups.group_photographs`: which photographs were taken with one camera, and what is known of it.
- `target_trial.try_targets`: which targets the photographs show, by trying a few of them.
"""
