"""Maximum-likelihood inverse reinforcement learning with temporal-logic side information."""

from jaxltl.algos.mlirl.learner import *  # noqa: F403
