"""``python -m benchmarks.hidden_modes FOLDER [--modes 1 3]``: hidden modes of real and simulated behaviour.

FOLDER has the mice in a binary maze of Rosenberg et al. (2021), ``train.npz`` with ``state`` and ``action``
``[N, T]`` and ``successor[S, A]``, and a grid world with two switching modes, ``switching_grid_train.npz``
with ``state``, ``action`` and ``transition[S, A, S]``. The maze: log-likelihoods per step in nats,
cross-validated in five folds of trajectories; everything, smoothing included, is fitted to the other four.
The grid: the expected agreement of the most probable modes with the true ones, and the agreement in
demonstrations simulated from the fitted model, whose modes are known.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path

import jax
import numpy as np

import jaxltl as jl
from jaxltl.algos import grounding
from jaxltl.algos.grounding import hidden_modes

FOLDS = 5


def trajectories(world, state, action):
    """Demonstrations of arrays ``[N, T]``."""
    return jl.make_trajectories(world, np.stack([state, action], -1).astype(int))


def maze(folder: Path, modes: list[int], num_starts: int, num_steps: int) -> None:
    """Prints the table of the maze: count tables of up to four past states, then modes."""
    data = np.load(folder / "train.npz")
    successor = data["successor"].astype(int)
    world = jl.make_mdp(successor[..., None], np.ones((*successor.shape, 1)))
    order = np.random.default_rng(0).permutation(len(data["state"]))
    rows: dict[str, list[float]] = {}
    spent: dict[str, float] = {}
    for fold in range(FOLDS):
        held, used = order[fold::FOLDS], np.sort(np.delete(order, np.s_[fold::FOLDS]))
        shown = trajectories(world, data["state"][used], data["action"][used])
        other = trajectories(world, data["state"][held], data["action"][held])
        tables = grounding.fit_history(world, shown)
        evidence, action = tables.evidence(other), np.asarray(other.action)
        level = np.take_along_axis(evidence, action[..., None, None], 2)[:, :, 0].mean((0, 1))
        for k in range(5):
            rows.setdefault(f"count table, {k} past states", []).append(float(level[k]))
        for number in modes:
            name, start = f"{number} modes", time.process_time()
            hparams = hidden_modes.Hparams()
            problem = hidden_modes.make_problem(world, shown, number, evidence=tables.left_out)
            state = hidden_modes.fit(
                jax.random.key(fold), problem, hparams, num_starts=num_starts, num_steps=num_steps
            ).state
            problem = hidden_modes.make_problem(world, other, number, evidence=evidence)
            found = hidden_modes.log_likelihood(state, problem, hparams)
            rows.setdefault(name, []).append(float(found.sum()) / action.size)
            spent[name] = spent.get(name, 0.0) + time.process_time() - start
            print(fold, name, rows[name][-1], flush=True)
    best = max(np.mean(rows[f"count table, {k} past states"]) for k in range(5))
    for name, values in rows.items():
        mean, cpu = np.mean(values), spent.get(name, 0) / FOLDS
        folds = " ".join(f"{x:.4f}" for x in values)
        print(f"{name:<28} {mean:8.4f} {mean - best:+8.4f}   {folds}   {cpu:6.1f} CPU s a fold")


def simulated(world, policy, moves, shape, seed=0):
    """States, actions and modes ``[N, T]`` of a known model: policies and moves by mode and state."""
    rng = np.random.default_rng(seed)
    num, steps = shape
    mode, found = rng.integers(len(policy), size=num), []
    state = rng.integers(world.num_states, size=num)
    transition = np.asarray(jl.models.to_dense(world).transition)

    def draw(p):
        return (rng.random((len(p), 1)) > np.cumsum(p, -1)[:, :-1]).sum(-1)

    for _ in range(steps):
        action = draw(policy[mode, state])
        found.append((state, action, mode))
        mode = draw(moves[state, mode])
        state = draw(transition[state, action])
    return np.stack(found, -1).transpose(1, 2, 0)


def entry_features(world):
    """``float[S, A, 2 S]``: the probability of each next state, and that of entering it from another."""
    after = np.asarray(jl.models.to_dense(world).transition)
    entry = after * ~np.eye(world.num_states, dtype=bool)[:, None]
    return np.concatenate([after, entry], -1)


def learned(world, state, action, hparams, num_starts):
    """A state and posterior modes of demonstrations, with entry rewards for each of two modes."""
    shown = trajectories(world, state, action)
    problem = hidden_modes.make_problem(world, shown, 2, features=entry_features(world))
    state = hidden_modes.fit(
        jax.random.key(0), problem, hparams, num_starts=num_starts, num_steps=200
    ).state
    return state, problem, np.asarray(hidden_modes.mode_probabilities(state, problem, hparams))


def grid(folder: Path, discounts: list[float], num_starts: int) -> None:
    """Prints the expected agreement, and the true one in simulations of the fitted model."""
    data = np.load(folder / "switching_grid_train.npz")
    world = jl.from_dense(data["transition"])
    for discount in discounts:
        hparams = hidden_modes.Hparams(discount=discount, learning_rate=0.1)
        start = time.process_time()
        state, problem, modes = learned(world, data["state"], data["action"], hparams, num_starts)
        total = float(hidden_modes.log_likelihood(state, problem, hparams).sum())
        cpu = time.process_time() - start
        policy = np.asarray(hidden_modes.policy(state, problem, hparams))
        moves = np.asarray(hidden_modes.mode_moves(state))
        drawn = simulated(world, policy, moves, data["state"].shape)
        _, _, again = learned(world, drawn[..., 0], drawn[..., 1], hparams, num_starts)
        share = float((again.argmax(-1) == drawn[..., 2]).mean())
        print(
            f"discount {discount}: log-likelihood per step {total / data['action'].size:.5f}, "
            f"expected agreement {modes.max(-1).mean():.4f}, {cpu:.0f} CPU s; "
            f"agreement in a simulation {max(share, 1 - share):.4f}, "
            f"expected {again.max(-1).mean():.4f}",
            flush=True,
        )


def main() -> None:
    """Both tables."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.hidden_modes", description=__doc__)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--modes", type=int, nargs="*", default=[1, 3])
    parser.add_argument("--discounts", type=float, nargs="*", default=[0.7, 0.8, 0.9])
    parser.add_argument("--starts", type=int, default=3)
    parser.add_argument("--steps", type=int, default=120)
    chosen = parser.parse_args()
    if chosen.modes:
        maze(chosen.folder, chosen.modes, chosen.starts, chosen.steps)
    grid(chosen.folder, chosen.discounts, chosen.starts)


if __name__ == "__main__":
    main()
