"""Terms of an objective and their ascent: functions of a few numbers, never an image."""

from mixpose.optimise.ascent import (
    Ascent as Ascent,
    NewtonOptions as NewtonOptions,
    Quadratic as Quadratic,
    Sum as Sum,
    Term as Term,
    ascend as ascend,
    stepped as stepped,
)
from mixpose.optimise.squares import (
    LinearResiduals as LinearResiduals,
    least_squares as least_squares,
    squares_of as squares_of,
)
