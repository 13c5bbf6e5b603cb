"""Questions about a world: boxes, contacts, visibility, free space."""
