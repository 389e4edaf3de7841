"""Reports: the findings of a result (`findings`), and the pages, tables and figures that show them.

`findings.findings_of` computes every number once, also those that nothing judges: of `precision`,
`network_geometry` and `rig_mounts`. `pages.PAGES` names, for each type of
result, the module that declares its page in the terms of `page`. `pages` renders a page as HTML and as plain
text; its tables write themselves as CSV and JSON. `survey_report` declares the report of a survey, and
`output.write_result` writes its folder with tables (`tables/`), plots and overlays (`figures/`). `phrases`
fixes how numbers and sentences are written everywhere.
"""
