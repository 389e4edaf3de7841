"""Files for other programs: the tables of a result (`csv_files`) and its key figures (`summary`)."""
