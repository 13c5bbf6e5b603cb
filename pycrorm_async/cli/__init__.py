"""The command `pycrorm`: one file a verb. Answers on stdout, everything else on stderr."""
