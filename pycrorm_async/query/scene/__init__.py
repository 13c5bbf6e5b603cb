"""Read the recorded geometry of a moment without Bullet: shapes of objects, poses of links, outlines from above."""
