from .attractor import (
    Attractor as Attractor,
    almost_surely_reaching as almost_surely_reaching,
    attractor as attractor,
    avoidable as avoidable,
)
from .end_components import EndComponents as EndComponents, end_components as end_components
