"""Simulation: recordings of a moving body with its true poses, made from a session file.

`recording` writes a recording; `motion` moves the body, `visible_spots` decides what a sensor sees,
`render` draws and writes it, and `naming` chooses the files.

Simulation shares only the sensors and the object model with the estimator, so that no estimate is
checked against itself.
"""

from mixpose.simulation.options import SimulationOptions as SimulationOptions
from mixpose.simulation.recording import simulate as simulate
