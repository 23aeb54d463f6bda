"""The constrained cross-entropy method."""

from jaxltl.algos.cce.learner import *  # noqa: F403
