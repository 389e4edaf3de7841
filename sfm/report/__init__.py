"""Reports: what is found in a result (`findings/`), and what prints it.

`findings.findings.findings_of` computes every number once. Renderers print: `html/` (pages from
templates), `text/` (report.txt), `tables/` (CSV and JSON), `figures/` (plots and overlays).
`output.write_result` writes the folder of a result. `numbers` and `phrases` are how numbers and sentences
are written everywhere. The modules `differences`, `validation`, `matching` and `resection` write what the
commands of these names find.
"""
