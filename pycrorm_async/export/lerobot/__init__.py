"""Write episodes as a LeRobot data set of version 3.0: states of the robot, tasks and subtasks, without images.

`states` makes the frames of an episode, `statistics` what LeRobot normalises with, `dataset` the files.
"""
