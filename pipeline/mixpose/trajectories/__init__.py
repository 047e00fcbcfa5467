"""What a whole recording of poses tells: smoothed poses, the tip of a tool, where the floor is.

`smoothing` smooths the poses of a body (`motion` says how it moves, `intensity` how much, `choices`
what ambiguous frames show); `pivot` finds a tip, `floor` the frame of the world.
"""
