"""Reports: what is found in a result (`findings/`), and what prints it.

`findings.findings.findings_of` computes every number once. A page is declared (`page`) by the module
that `pages.PAGES` names for the type of a result; one renderer a medium writes it: `html`, `text`, and the
tables themselves CSV and JSON. `survey_report` declares the report of a survey, and `output.write_result`
writes its folder with tables (`tables/`), plots and overlays (`figures/`). `numbers` and `phrases` are how
numbers and sentences are written everywhere.
"""
