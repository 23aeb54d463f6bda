"""Statuses and widths of float32 enclosures inside ``jit`` and ``vmap``, and outside.

    JAX_PLATFORMS=cpu python -m benchmarks.float32_lanes --lanes 50

Random products of about 200 states, slippery and with self-loops, a quarter of the states left with
probability .002. Every enclosure is compared with one of the normalised rows in double precision.
"""

import argparse
import time
from collections import Counter
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np

import jaxltl as jl

FORMULAS = ("F a", "!b U a", "F (a & F b)", "G F a & G F b")
SIZE, DISCOUNT = 200, 0.999


def random_world(rng, num_states, sticky=0.998):
    """A float32 world with 3 actions and 4 successors; the last two states are absorbing."""
    # One of the two is entered with a probability of about .005 in each step, except by waiting,
    # which half of the worlds allow in some states.
    shape = (num_states, 3, 4)
    successor = rng.integers(0, num_states - 2, shape)
    weight = rng.dirichlet(np.ones(4), shape[:2]) * [1, 1, 1, 0.02]
    weight /= weight.sum(-1, keepdims=True)
    successor[..., 0] = np.arange(num_states)[:, None]
    successor[..., 3] = num_states - rng.integers(1, 3, shape[:2])
    slow = rng.random(num_states) < 0.25
    weight[slow] *= 1 - sticky
    weight[slow, :, 0] += sticky
    if rng.random() < 0.5:
        weight[rng.random(num_states) < 0.1, 2] = [1, 0, 0, 0]
    successor[-2:], weight[-2:] = np.arange(num_states)[-2:, None, None], [1, 0, 0, 0]
    label = np.zeros((num_states, 2), bool)
    label[rng.permutation(num_states - 2)[:4], 0] = True
    label[rng.permutation(num_states - 2)[:4], 1] = True
    label[-2] = True
    return jl.make_mdp(successor, weight, label=label, propositions=["a", "b"])


def random_products(formula, count, size=SIZE, seed=0):
    """Products of one formula with random worlds of one shape."""
    rng = np.random.default_rng(seed)
    memory = jl.product(random_world(rng, 8), formula).num_memory
    return [jl.product(random_world(rng, size // memory), formula) for _ in range(count)]


def last_two(model):
    """The absorbing states of the world, in every memory state."""
    absorbing = np.arange(model.mdp.num_states) >= model.mdp.num_states - 2
    return jnp.broadcast_to(jnp.asarray(absorbing)[:, None], model.state_shape)


def uniform(model):
    shape = (*model.state_shape, model.num_actions)
    return jnp.full(shape, 1 / model.num_actions, model.dtype)


def earned(model, scale=1.0):
    shape = (*model.state_shape, model.num_actions)
    reward = (scale * np.random.default_rng(1).random(shape)).astype(np.float32)
    return jnp.asarray(reward, model.dtype)


def winning(model):
    """Absorbing states that show both labels."""
    good = np.arange(model.mdp.num_states) == model.mdp.num_states - 2
    return jnp.broadcast_to(jnp.asarray(good)[:, None], model.state_shape)


QUESTIONS = {
    "optimal satisfaction": lambda m, width: jl.optimal_satisfaction(m, tolerance=width),
    "satisfaction": lambda m, width: jl.satisfaction_probability(m, uniform(m), tolerance=width),
    "least reachability": lambda m, width: jl.reachability_probability(
        m, winning(m), objective="min", tolerance=width
    ),
    "largest total reward": lambda m, width: jl.total_reward(
        m, earned(m), last_two(m), tolerance=width
    ),
    "steps of a policy": lambda m, width: jl.total_reward(
        m, jnp.ones(m.state_shape), last_two(m), policy=uniform(m), tolerance=width
    ),
    "value of a policy": lambda m, width: jl.policy_value(
        m, uniform(m), earned(m, 1 - DISCOUNT), DISCOUNT, tolerance=width
    ),
    "optimal value": lambda m, width: jl.optimal_value(
        m, earned(m, 1 - DISCOUNT), DISCOUNT, tolerance=width
    ),
}


def in_double(model):
    """The product with the normalised float32 rows, in double precision."""
    world = model.mdp
    exact = jl.make_mdp(
        np.asarray(world.successor),
        np.asarray(world.probability, np.float64),
        label=np.asarray(world.label),
        propositions=world.propositions,
    )
    return jl.product(exact, model.automaton)


def truth(ask, model):
    """An enclosure of width 1e-9 from double precision outside ``jit``."""
    with jax.enable_x64(True):
        found = ask(in_double(model), 1e-9)
        return np.asarray(found.lower), np.asarray(found.upper)


def wrong(found, exact):
    """Whether an enclosure misses the exact one."""
    low, high = (np.asarray(x, np.float64) for x in (found.lower, found.upper))
    return bool((low > exact[1]).any() or (high < exact[0]).any())


def width(found, relative):
    """The largest width of each lane."""
    low, high = (np.asarray(x, np.float64) for x in (found.lower, found.upper))
    both = np.isfinite(low) & np.isfinite(high)
    gap = np.where(both, high, 0) - np.where(both, low, 0)
    each = np.where(both, gap, np.where(low == high, 0, np.inf))
    if relative:
        each = each / np.where(both, np.maximum(high, 1e-30), 1)
    return each.max(axis=(-2, -1))


def main():
    options = argparse.ArgumentParser(description=__doc__)
    options.add_argument("--lanes", type=int, default=50, help="products of each formula")
    options.add_argument("--width", type=float, default=1e-5, help="tolerance")
    options.add_argument("--checked", type=int, default=5, help="lanes compared with float64")
    given = options.parse_args()
    models = {f: random_products(f, given.lanes) for f in FORMULAS}
    print(
        f"{'question':22s} {'where':8s} {'statuses':36s} {'median':>8s} {'largest':>8s} {'s':>6s}"
    )
    for name, ask in QUESTIONS.items():
        relative = "reward" in name or "steps" in name
        rows = {"lanes": [], "alone": []}
        seconds, missed = Counter(), 0
        for formula in FORMULAS:
            batch = models[formula]
            lanes = jax.jit(jax.vmap(partial(ask, width=given.width)))
            stack = jax.tree.map(lambda *x: jnp.stack(x), *batch)
            jax.block_until_ready(lanes(stack))
            begun = time.process_time()
            found = jax.tree.map(np.asarray, lanes(stack))
            seconds["lanes"] += time.process_time() - begun
            begun = time.process_time()
            alone = [ask(m, given.width).replace(method="") for m in batch]
            seconds["alone"] += time.process_time() - begun
            alone = jax.tree.map(lambda *x: np.stack([np.asarray(y) for y in x]), *alone)
            rows["lanes"].append((found.status, width(found, relative)))
            rows["alone"].append((alone.status, width(alone, relative)))
            for i in range(min(given.checked, len(batch))):
                exact = truth(ask, batch[i])
                for every in (found, alone):
                    missed += wrong(jax.tree.map(lambda x, i=i: x[i], every), exact)
        for place, parts in rows.items():
            status, wide = (np.concatenate(x) for x in zip(*parts, strict=True))
            counts = Counter(jl.Status(int(s)).name for s in status)
            text = ", ".join(f"{k} {n}" for k, n in counts.most_common())
            print(
                f"{name:22s} {place:8s} {text:36s} {np.median(wide):8.1e} {wide.max():8.1e} "
                f"{seconds[place]:6.1f}",
                flush=True,
            )
        if missed:
            print(f"  {missed} enclosures miss the exact value")


if __name__ == "__main__":
    main()
