"""Query a world without changing it: bounding boxes, collisions, visibility, free space."""
