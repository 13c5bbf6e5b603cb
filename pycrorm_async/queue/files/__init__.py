"""Read and write the files of a spool: frames, segments, locks, notes."""
