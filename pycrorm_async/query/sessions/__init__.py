"""Sessions of the reading side: related rows by episode, and attributes that are loaded when they are read."""
