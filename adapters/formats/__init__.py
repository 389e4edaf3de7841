"""The file formats of other programs, one module each behind one row of `registry.FORMATS`.

To add a format: a module with a reader (path to network and estimate) and, where it can be, a writer; then a
`FileFormat` in `registry.FORMATS`, which says its name, which files are its own and what it can hold.
`adapters.reading` reads text and XML with line numbers for the messages, `sfm.files.json_files` JSON.
"""
