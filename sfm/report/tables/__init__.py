"""Files for programs: the tables of a result (`csv_files`) and its figures (`summary`)."""
