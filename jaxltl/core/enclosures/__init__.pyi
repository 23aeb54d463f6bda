from .enclose import enclose as enclose, linear_bounds as linear_bounds
from .interval import Interval as Interval
from .linear_bounds import LinearForm as LinearForm
