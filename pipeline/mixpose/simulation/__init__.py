"""Simulation: recordings of a moving body with its true poses, made from a session file.

`recording` is the whole; `motion` says where the body is, `visible_spots` what a sensor sees of it,
`render` how that looks and is written, `naming` where.

Of all that estimates poses, simulation knows only the sensors and the object model, so that no
estimate is checked against itself.
"""

from mixpose.simulation.options import SimulationOptions as SimulationOptions
from mixpose.simulation.recording import simulate as simulate
