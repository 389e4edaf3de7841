"""The file formats of other programs, one module each behind one row of `registry.FORMATS`.

To add a format: a module with a reader (path to network and estimate) and, where it can be, a writer; then a
`FileFormat` in `registry.FORMATS`, which states its name, how its files are recognised and what it can keep.
`adapters.reading` reads text and XML with line numbers for the messages, `sfm.files.plain_text` JSON.
"""
