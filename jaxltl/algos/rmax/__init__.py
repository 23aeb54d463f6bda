"""R-max: PAC learning of rewards and probabilities inside the almost-sure winning region."""

from jaxltl.algos.rmax.learner import *  # noqa: F403
