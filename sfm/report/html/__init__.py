"""Pages for a browser: templates (`templates/`), and `page.render`, which fills them.

`report.report_page` is the report of a survey. A page allows what it holds and nothing else
(`content_policy`).
"""
