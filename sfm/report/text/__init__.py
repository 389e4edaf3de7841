"""report.txt: `report.text_report` fills the template `report.txt`; `lines` sets its columns."""
