"""The file formats of other programs: one module each, behind one row of `registry.FORMATS`.

To add a format, write a module with a reader (path to network and estimate) and, if possible, a writer. Then
add a `FileFormat` to `registry.FORMATS` with its name, how its files are recognised and what it can store.
`adapters.reading` reads text and XML with line numbers for messages; `sfm.files.plain_text` reads JSON.
"""
