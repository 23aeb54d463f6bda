"""Proximal policy optimisation (PPO) in any environment."""

from jaxltl.algos.ppo.learner import *  # noqa: F403
