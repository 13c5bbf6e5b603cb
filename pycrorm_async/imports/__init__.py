"""Record the files of other programs as episodes: traces, bags, logs of behaviour trees, data sets.

`intake` is the seam between a format, which reads files, and the memory, which records. `registry` finds a format by
its name and runs an import. Each other module is one format, or what several share (`spans`).
"""
