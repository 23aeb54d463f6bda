from .interval import Interval as Interval
from .linear_bounds import (
    LinearForm as LinearForm,
    enclose as enclose,
    linear_bounds as linear_bounds,
)
