"""Q-learning of maximin values in turn-based games."""

from jaxltl.algos.maximin_q.learner import *  # noqa: F403
