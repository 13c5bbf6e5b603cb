"""Ask a memory questions by name: each is a select that can be read, changed and run."""
