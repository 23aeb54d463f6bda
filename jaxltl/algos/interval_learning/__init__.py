"""Robust anytime learning of interval models."""

from jaxltl.algos.interval_learning.learner import *  # noqa: F403
