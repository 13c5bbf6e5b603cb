"""The files of a spool: frames, segments, locks, how they are read."""
