"""Location designators: search poses for the robot's base and for placing objects."""
