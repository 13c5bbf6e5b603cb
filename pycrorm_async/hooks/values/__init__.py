"""Values of parameters as events hold them: read, shortened where they are too long, marked where they are missing."""
