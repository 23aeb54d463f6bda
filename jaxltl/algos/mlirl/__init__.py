"""Maximum-likelihood inverse reinforcement learning with temporal-logic side information."""

from jaxltl.algos.mlirl.guaranteed import (
    Demands as Demands,
    GuaranteedPolicy as GuaranteedPolicy,
    train_guaranteed as train_guaranteed,
)
from jaxltl.algos.mlirl.learner import *  # noqa: F403
