"""Values of small multi-player games by trying all pairs of positional strategies.

Positional strategies of both sides suffice for reachability, parity, total and average rewards of
turn-based stochastic games, so each joint choice of rows leaves a chain, and the value of a coalition
is the largest over its choices of the least over the choices of the others.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

import jaxltl as jl

_SQUARINGS = 60


@dataclass
class RandomGame:
    """A game of three players with labels a and b and rewards of choices."""

    rows: list[list[np.ndarray]]  # of each state the distributions of its choices
    reward: list[list[float]]
    owner: np.ndarray
    label: np.ndarray  # bool[S, 2]
    joint: list[tuple[int, ...]] = field(default_factory=list)

    @property
    def size(self) -> int:
        return len(self.rows)

    @cached_property
    def model(self):
        flat = [row for choices in self.rows for row in choices]
        entries = [np.flatnonzero(row) for row in flat]
        sparse = jl.make_sparse(
            np.cumsum([0, *map(len, self.rows)]),
            np.cumsum([0, *map(len, entries)]),
            np.concatenate(entries),
            np.concatenate([row[e] for row, e in zip(flat, entries, strict=True)]),
            label=self.label,
            propositions=["a", "b"],
            rewards={
                "r": jl.models.Rewards(choice=[x for xs in self.reward for x in xs]),
                "w": jl.models.Rewards(state=self.label[:, 0].astype(float)),
            },
        )
        return jl.models.make_multiplayer_game(sparse, self.owner, ["p1", "p2", "p3"])

    # --- chains of joint strategies ---

    @cached_property
    def chains(self) -> tuple[np.ndarray, np.ndarray]:
        """Matrices ``[J, S, S]`` and rewards ``[J, S]`` of all joint positional strategies."""
        joint = list(itertools.product(*(range(len(choices)) for choices in self.rows)))
        matrix = np.array([[self.rows[s][a] for s, a in enumerate(one)] for one in joint])
        reward = np.array([[self.reward[s][a] for s, a in enumerate(one)] for one in joint])
        return matrix, reward

    def coalition_value(self, quantity: np.ndarray, members: set[int]) -> np.ndarray:
        """The value ``[S]`` of a quantity ``[J, S]`` that the members maximise."""
        table = quantity.reshape(*(len(choices) for choices in self.rows), self.size)
        others = tuple(s for s in range(self.size) if self.owner[s] not in members)
        inside = tuple(s for s in range(self.size) if self.owner[s] in members)
        least = table.min(axis=others, keepdims=True)
        return least.max(axis=inside, keepdims=True).reshape(self.size)

    def reached(self, target: np.ndarray, stay: np.ndarray | None = None) -> np.ndarray:
        """Probabilities ``[J, S]`` of reaching a target through states of `stay`."""
        matrix = self.absorbing(target if stay is None else target | ~stay)[0]
        return _limit(matrix) @ target.astype(float)

    def absorbing(self, states: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        matrix, reward = self.chains
        loops = np.eye(self.size)
        return np.where(states[:, None], loops, matrix), np.where(states, 0, reward)

    def recurrent(self, good) -> np.ndarray:
        """Probabilities ``[J, S]`` of a recurrent class that is good: of reachability ``[J, S, S]``."""
        matrix, _ = self.chains
        after = _closure(matrix)
        inside = (~after | after.swapaxes(1, 2)).all(2)
        return (_limit(matrix) * (inside & good(after))[:, None, :]).sum(-1)

    def total(self, target: np.ndarray, *, unreached: str) -> np.ndarray:
        """Total rewards ``[J, S]`` until a target."""
        matrix, reward = self.absorbing(target)
        after = _closure(matrix)
        inside = (~after | after.swapaxes(1, 2)).all(2)
        earning = inside & (after & (reward > 0)[:, None, :]).any(2)
        bad = earning if unreached == "sum" else inside & ~target
        infinite = (after & bad[:, None, :]).any(2)
        value, power = np.where(inside, 0, reward), matrix
        for _ in range(_SQUARINGS):
            value = value + np.einsum("jst,jt->js", power, value)
            power = power @ power
            power /= power.sum(-1, keepdims=True)
            value = np.where(infinite, 0, value)
        return np.where(infinite, np.inf, value)

    def discounted(self, target: np.ndarray, factor: float) -> np.ndarray:
        """Discounted rewards ``[J, S]`` until a target."""
        matrix, reward = self.absorbing(target)
        return np.linalg.solve(np.eye(self.size) - factor * matrix, reward[..., None])[..., 0]

    def average(self, reward: np.ndarray | None = None) -> np.ndarray:
        matrix, earned = self.chains
        reward = earned if reward is None else np.broadcast_to(reward, earned.shape)
        return np.einsum("jst,jt->js", _limit(matrix), reward)

    def maximised(self, members: set[int]) -> set[int]:
        """The states of the members."""
        return {s for s in range(self.size) if self.owner[s] in members}

    # --- steps ---

    def backward(
        self,
        value: np.ndarray,
        members: set[int],
        num_steps: int,
        *,
        earn: bool = False,
        factor: float = 1.0,
        kept: np.ndarray | None = None,
    ) -> np.ndarray:
        """Optimal expected values after some steps, with rewards of the steps; states of `kept` keep theirs."""
        kept = np.zeros(self.size, bool) if kept is None else kept
        for _ in range(num_steps):
            value = np.array(
                [
                    value[s]
                    if kept[s]
                    else (max if self.owner[s] in members else min)(
                        row[row > 0] @ value[row > 0] * factor + earn * c
                        for row, c in zip(self.rows[s], self.reward[s], strict=True)
                    )
                    for s in range(self.size)
                ]
            )
        return value


def least_if_reached(
    game: RandomGame, target: np.ndarray, members: set[int], steps: int, limit: int
) -> np.ndarray:
    """Rewards that count if the target is reached within some steps and below a limit of reward."""
    size = game.size
    most = int(max(max(x) for x in game.reward))
    levels = np.arange(limit + most + 1)
    value = np.where(target, levels[:, None], 0).astype(float)
    for _ in range(steps):
        new = np.where(target, levels[:, None], 0).astype(float)
        for s in np.flatnonzero(~target):
            options = []
            for row, earned in zip(game.rows[s], game.reward[s], strict=True):
                ahead = value[int(earned) : int(earned) + limit + 1] @ row
                options.append(ahead)
            best = np.max if s in game.maximised(members) else np.min
            new[: limit + 1, s] = best(options, axis=0)
        if np.abs(new - value).max() < 1e-13:
            break
        value = new
    assert value.shape[1] == size
    return value[0]


def _limit(matrix: np.ndarray) -> np.ndarray:
    """Limits of lazy chains, whose averages are those of the chains."""
    power = (np.eye(matrix.shape[-1]) + matrix) / 2
    for _ in range(_SQUARINGS):
        power = power @ power
        power /= power.sum(-1, keepdims=True)
    return power


def _closure(matrix: np.ndarray) -> np.ndarray:
    after = (matrix > 0) | np.eye(matrix.shape[-1], dtype=bool)
    for _ in range(4):
        after = (after.astype(int) @ after.astype(int)) > 0
    return after


def random_smg(seed: int, most: int = 8) -> RandomGame:
    """A game of three players with up to `most` states and at most 256 joint strategies."""
    rng = np.random.default_rng(seed)
    size = int(rng.integers(2, most + 1))
    counts = rng.integers(1, 4, size)
    while np.prod(counts) > 256:
        counts[rng.integers(size)] = 1
    rows, reward = [], []
    for count in counts:
        choices = []
        for _ in range(count):
            support = rng.choice(size, int(rng.integers(1, min(3, size) + 1)), replace=False)
            weight = rng.integers(1, 4, support.size)
            row = np.zeros(size)
            row[support] = weight / weight.sum()
            choices.append(row)
        rows.append(choices)
        reward.append(rng.choice([0, 0, 0, 1, 2], count).astype(float).tolist())
    label = rng.random((size, 2)) < 0.3
    return RandomGame(rows, reward, rng.integers(0, 3, size), label)
