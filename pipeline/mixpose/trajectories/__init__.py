"""Evaluate a whole recording of poses: smooth them, find the tip of a tool, find the floor.

`smoothing` smooths the poses of a body (`motion` models its motion, `intensity` fits the model,
`choices` resolves ambiguous frames); `pivot` finds a tip, `floor` a frame for the world.
"""
