"""Trust-region policy optimisation (TRPO) and constrained policy optimisation (CPO)."""

from jaxltl.algos.trust_region.learner import *  # noqa: F403
