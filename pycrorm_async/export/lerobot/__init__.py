"""Write episodes as a LeRobot data set of version 3.0: states of the robot, tasks and subtasks, and images on request.

`states` makes the frames of an episode, `images` draws the scene of each frame, `statistics` computes the values with
which LeRobot normalises, and `dataset` writes the files.
"""
