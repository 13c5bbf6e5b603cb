"""Write episodes, questions and views to files in the formats of other programs.

`export.py` is the entry: it resolves what to export (`selection`), lets a format write it into a temporary file that
gets its name when it is complete (`report/output_files`), and describes the result (the manifest in `selection`), so
that it can be made again.
"""
