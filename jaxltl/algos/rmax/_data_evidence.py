"""What counted transitions of a game guarantee of a strategy, without the game itself."""

from __future__ import annotations

from typing import Any

import numpy as np
from flax import struct

from jaxltl.core.models.game import Game
from jaxltl.core.models.interval import interval_rows
from jaxltl.core.models.sparse import Rewards
from jaxltl.core.pretty_print import brief
from jaxltl.core.sparse.rows import offsets_from_counts
from jaxltl.core.statistics.confidence_sets import Method, intervals_from_counts
from jaxltl.core.values.interval.robust import robust_discounted_value


@brief
@struct.dataclass
class DataEvidence:
    """Bounds that hold with a confidence, all at once; NaN outside of the region.

    Attributes:
      secured: ``float64[S]``, what the strategy has against every environment, at least.
      optimal: ``float64[S]``, what no strategy in the region can secure more than.
      confidence: the chance that data are drawn of which this is true.
      num_samples: how many transitions were counted.
    """

    secured: Any
    optimal: Any
    confidence: float = struct.field(pytree_node=False)
    num_samples: int = struct.field(pytree_node=False)


def data_evidence(
    game: Game,
    allowed: Any,
    region: Any,
    reward: Any,
    counts: Any,
    play: Any,
    discount: float,
    confidence: float,
    method: Method = "anytime",
) -> DataEvidence:
    """Bounds of a strategy's and of the best discounted value, of what was counted alone.

    The graph and the rewards of transitions are taken as known, as by the learner.

    Args:
      game: a padded game; its graph counts, its probabilities do not.
      allowed, region: the moves ``bool[S, A]`` and states ``bool[S]`` in which both play.
      reward: ``float[S, A]`` or ``[S, A, K]``.
      counts: ``int[S, A, K]``.
      play: ``float[S, A]``, the system's strategy.
      discount: in ``[0, 1)``.
      confidence, method: as of :func:`~jaxltl.core.statistics.confidence_sets.intervals_from_counts`.
    """
    region, mdp = np.asarray(region), game.mdp
    state = np.flatnonzero(region)
    number = np.zeros(region.size, np.int64)
    number[state] = np.arange(state.size)
    moves = np.asarray(allowed) & region[:, None]
    used = moves[..., None] & (np.asarray(mdp.probability) > 0)
    s, a = np.nonzero(moves)
    start = offsets_from_counts(used.sum(-1)[s, a])
    reward = np.asarray(reward, np.float64)
    earned = np.broadcast_to(reward[..., None] if reward.ndim == 2 else reward, used.shape)
    count = np.asarray(counts)[used]
    sets = intervals_from_counts(count, confidence, method=method, entry_start=start)
    model = interval_rows(
        offsets_from_counts(moves.sum(-1)[state]),
        start,
        number[np.asarray(mdp.successor)[used]],
        sets.lower,
        sets.upper,
        center=None if sets.radius is None else sets.center,
        radius=sets.radius,
        rewards={"reward": Rewards(transition=earned[used])},
    )
    system: Any = np.asarray(game.system)[state]
    within = Game(model, system)
    weight = np.asarray(play, np.float64)[s, a]
    secured = robust_discounted_value(within, "reward", discount, policy=weight, nature="min")
    optimal = robust_discounted_value(within, "reward", discount, nature="max")
    found = np.full((2, region.size), np.nan)
    found[0, state], found[1, state] = secured.lower, optimal.upper
    return DataEvidence(found[0], found[1], float(confidence), int(count.sum()))
