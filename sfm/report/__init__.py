"""Reports: what is found in a result (`findings/`), and what prints it.

`findings.survey_remarks.findings_of` computes every number once. A page is declared (`page`) by the module
that `pages.PAGES` names for the type of a result; `pages` renders it as HTML and as plain text, and its
tables write themselves as CSV and JSON. `survey_report` declares the report of a survey, and
`output.write_result` writes its folder with tables (`tables/`), plots and overlays (`figures/`). `phrases` is
how numbers and sentences are written everywhere.
"""
