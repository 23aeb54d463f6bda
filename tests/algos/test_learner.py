"""Laws that every learner keeps: one suite, parametrised over learners."""

from __future__ import annotations

import os
from functools import cache, partial
from types import SimpleNamespace
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import struct

import jaxltl as jl
from jaxltl.algos import (
    behavioral_cloning,
    cce,
    learner,
    maximin_q,
    mlirl,
    rmax,
    todirl,
    trust_region,
)
from jaxltl.algos.exponential_family import diagonal_gaussian
from jaxltl.core.models.game import make_game
from tests.support import counted_traces


class Case(NamedTuple):
    """A learner, a problem for it, and two settings of the same kind."""

    module: Any
    problem: Any
    hparams: Any
    other: Any


@struct.dataclass
class ToyState:
    key: jax.Array
    step: jax.Array
    position: jax.Array


def toy_init(key, problem, hparams):
    return ToyState(key, jnp.int32(0), problem + jax.random.normal(key, problem.shape))


def toy_step(state, problem, hparams):
    """A noisy descent, which uses its key as learners do."""
    noise = jax.random.normal(jax.random.fold_in(state.key, state.step), problem.shape)
    position = state.position - hparams * (state.position - problem + noise)
    return ToyState(state.key, state.step + 1, position), {"at": state.step, "x": position.sum()}


TOY = SimpleNamespace(
    init=toy_init, step=toy_step,
    run=partial(learner.run, toy_step), train=partial(learner.train, toy_init, toy_step),
)


def grid():
    world = jl.gridworld("b . r\n. . g", slip=0.1, absorbing=["g"])
    runs = [[(0, 1), (3, 3), (4, 3)], [(0, 3), (1, 1), (4, 3)]]
    return world, jl.make_trajectories(world, runs)


def mlirl_world():
    world, demonstrations = grid()
    features = mlirl.world_features(world, demonstrations, goal=["g"], avoid=["r"]).values
    setting = partial(mlirl.Hparams, optimizer="adam")
    return Case(
        mlirl, mlirl.make_problem(world, features, demonstrations),
        setting(discount=0.5), setting(discount=0.4, l2=1e-2, learning_rate=0.01),
    )


def mlirl_product():
    world, demonstrations = grid()
    lazy = jl.product(world, "!r U g")
    features = mlirl.task_features(lazy, demonstrations, avoid=["r"]).values
    return Case(
        mlirl, mlirl.make_problem(lazy, features, demonstrations),
        mlirl.Hparams(discount=0.5, mu=0.1), mlirl.Hparams(discount=0.6, mu=1.0, l2=1e-2),
    )


def task_oriented():
    world, demonstrations = grid()
    problem = todirl.make_problem(
        jl.product(world, "!r U g", label_on="exit"), np.eye(6), demonstrations,
        network=todirl.RewardNetwork((3,)), held_out=0.5,
    )
    return Case(
        todirl, problem, todirl.Hparams(discount=0.9, patience=3),
        todirl.Hparams(discount=0.8, l2=0.1, learning_rate=0.05, patience=4),
    )


def alternating_game():
    """Two of the system's states between two of the environment's, where chance plays."""
    successor = [[[2, 0], [3, 0]], [[3, 0], [2, 0]], [[0, 1], [1, 0]], [[1, 0], [0, 1]]]
    certain, fair = [[1, 0], [1, 0]], [[0.5, 0.5], [1, 0]]
    mdp = jl.make_mdp(successor, [certain, certain, fair, fair])
    reward = [[1.0, 0.0], [0.0, 0.5], [0.2, 0.0], [0.0, 0.3]]
    return make_game(mdp, [True, True, False, False]), reward


def q_learning(method):
    setting = partial(
        maximin_q.Hparams, step_size=1.0, step_power=0.7, epsilon=0.5, environment_epsilon=0.5,
        num_chains=3, moves_per_step=5,
    )
    return Case(
        maximin_q, maximin_q.make_problem(*alternating_game(), method=method),
        setting(discount=0.5), setting(discount=0.7, step_size=0.5, restart=0.2, epsilon=0.1),
    )


def pac_learning():
    game, reward = alternating_game()
    setting = partial(rmax.Hparams, known_after=3, epsilon=0.1, reward_bound=1.0, moves_per_step=7)
    return Case(
        rmax, rmax.make_problem(game, np.arange(4) == 0, reward, start=np.full(4, 0.25)),
        setting(discount=0.5, restart=0.1), setting(discount=0.6, restart=0.3),
    )


def noisy_quadratic(x, key):
    return jax.random.normal(key) - jnp.sum((x - 1.0) ** 2), jnp.sum(x)


def cross_entropy():
    problem = cce.make_problem(noisy_quadratic, diagonal_gaussian(jnp.zeros(2), 1.0), limit=1.0)
    setting = partial(cce.Hparams, population=10, elite_reuse=True)
    return Case(
        cce, problem, setting(rate=cce.Polynomial(0.5, -0.5)),
        setting(rate=cce.Polynomial(0.9, -0.2), temperature=2.0),
    )


def choice_reset(key):
    return jax.random.normal(key, (2,))


def choice_step(world, action, key):
    """A point pushed about; the reward is for being near, the cost is the push."""
    place = world + 0.3 * action
    return place, -jnp.sum(place**2), jnp.sum(action**2), jnp.abs(place).max() > 4


def choice_observe(world):
    return world


def trust(method):
    setting = partial(
        trust_region.Hparams, method=method, num_trajectories=6, hidden=(3,), value_hidden=(3,),
        cg_steps=3, value_epochs=1, value_batches=2,
    )
    problem = trust_region.make_problem(
        choice_reset, choice_step, choice_observe, num_actions=2, horizon=4, limit=6.0
    )
    return Case(
        trust_region, problem, setting(discount=0.9),
        setting(discount=0.8, delta=0.02, cost_discount=0.9, value_rate=0.1),
    )


def cloning():
    world, demonstrations = grid()
    network = behavioral_cloning.DensePolicy(hidden=(4,))
    problem = behavioral_cloning.make_problem(
        jl.product(world, "!r U g"), jnp.eye(6), demonstrations, held_out=0.5, network=network)
    setting = partial(behavioral_cloning.Hparams, batch=5)
    return Case(
        behavioral_cloning, problem, setting(), setting(learning_rate=0.1, l2=0.1, patience=3))


LEARNERS = {
    "toy": lambda: Case(TOY, jnp.arange(3.0), 0.1, 0.2),
    "mlirl-world": mlirl_world,
    "mlirl-product": mlirl_product,
    "todirl": task_oriented,
    "q-generalized": partial(q_learning, "generalized"),
    "q-maximin": partial(q_learning, "maximin"),
    "rmax": pac_learning,
    "trpo": partial(trust, "trpo"),
    "cpo": partial(trust, "cpo"),
    "cce": cross_entropy,
    "cloning": cloning,
}

# What a state has learned, by name; the first that it has.
LEARNED = ("parameters", "q", "counts", "family", "position")


@cache
def case(name: str) -> Case:
    return LEARNERS[name]()


@cache
def six_steps(name: str):
    """The state and metrics after six steps; the runs below have the same seed."""
    module, problem, hparams, _ = case(name)
    return module.train(jax.random.key(0), problem, hparams, num_steps=6)


def start(name: str, seed: int = 0):
    module, problem, hparams, _ = case(name)
    return module.init(jax.random.key(seed), problem, hparams)


def leaves(tree):
    """The numbers of a tree, those of keys too."""
    return [
        np.asarray(jax.random.key_data(x) if jnp.issubdtype(x.dtype, jax.dtypes.prng_key) else x)
        for x in map(jnp.asarray, jax.tree.leaves(tree))
    ]


def assert_bitwise(one, other):
    assert jax.tree.structure(one) == jax.tree.structure(other)
    for x, y in zip(leaves(one), leaves(other), strict=True):
        assert x.dtype == y.dtype
        np.testing.assert_array_equal(x, y)


# To compile, which is done several times.
SLOW = {"mlirl-product", "q-maximin", "trpo", "cpo", "todirl"}
by_learner = pytest.mark.parametrize(
    "name",
    [pytest.param(n, marks=[pytest.mark.exhaustive] if n in SLOW else []) for n in LEARNERS],
)


@by_learner
def test_a_run_split_in_two_is_the_run(name):
    module, problem, hparams, _ = case(name)
    state, first = module.run(start(name), problem, hparams, num_steps=3)
    state, second = module.run(state, problem, hparams, num_steps=3)
    whole, metrics = six_steps(name)
    assert_bitwise(state, whole)
    joined = jax.tree.map(lambda x, y: jnp.concatenate([x, y]), first, second)
    assert_bitwise(joined, metrics)
    assert state.step == 6


@by_learner
def test_a_lane_is_as_if_alone(name):
    """Up to rounding: a batch is compiled to other instructions, so the bits may differ."""
    module, problem, hparams, _ = case(name)
    keys = jax.random.split(jax.random.key(0), 3).at[0].set(jax.random.key(0))
    states, _ = jax.vmap(lambda k: module.train(k, problem, hparams, num_steps=6))(keys)
    alone, _ = six_steps(name)
    for x, y in zip(leaves(states), leaves(alone), strict=True):
        np.testing.assert_allclose(x[0], y, rtol=1e-8, atol=1e-8)
    learned = leaves(next(getattr(states, x) for x in LEARNED if hasattr(states, x)))
    assert any((x[0] != x[1]).any() for x in learned), "distinct keys give distinct runs"


@by_learner
def test_the_key_decides(name):
    module, problem, hparams, _ = case(name)
    again, _ = module.train(jax.random.key(0), problem, hparams, num_steps=6)
    assert_bitwise(again, six_steps(name)[0])
    other, _ = module.train(jax.random.key(1), problem, hparams, num_steps=6)
    differs = [(x != y).any() for x, y in zip(leaves(other), leaves(again), strict=True)]
    assert sum(differs) >= 2, "more than the key itself"


@by_learner
def test_new_settings_do_not_retrace(name):
    module, problem, hparams, other = case(name)
    run = partial(module.run, start(name), problem)
    one, _ = run(hparams, num_steps=3)
    with counted_traces() as traced:
        two, _ = run(other, num_steps=3)
    assert not traced
    assert any((x != y).any() for x, y in zip(leaves(one), leaves(two), strict=True))


@by_learner
def test_a_saved_state_goes_on_bitwise(name, tmp_path):
    module, problem, hparams, _ = case(name)
    state, _ = module.run(start(name), problem, hparams, num_steps=3)
    learner.save(tmp_path / "state.npz", state)
    loaded = learner.load(tmp_path / "state.npz", start(name, seed=7))
    assert_bitwise(loaded, state)
    state, _ = module.run(loaded, problem, hparams, num_steps=3)
    assert_bitwise(state, six_steps(name)[0])


@by_learner
def test_an_interrupted_run_resumes_and_ends_bitwise_equal(name, tmp_path):
    module, problem, hparams, _ = case(name)
    checkpoint = tmp_path / "run.npz"
    seen = []

    def interrupt(done, metrics):
        seen.append(done)
        raise KeyboardInterrupt

    run = partial(
        learner.run_in_chunks, module.step, problem=problem, hparams=hparams,
        num_steps=6, chunk=3, checkpoint=checkpoint,
    )
    with pytest.raises(KeyboardInterrupt):
        run(state=start(name), report=interrupt)
    state, metrics = run(state=start(name), report=lambda done, _: seen.append(done))
    assert seen == [3, 6]
    assert_bitwise(state, six_steps(name)[0])
    assert jax.tree.leaves(metrics)[0].shape[0] == 3, "the metrics of this call's steps"
    state, metrics = run(state=start(name))
    assert metrics is None, "nothing is left to do"
    assert_bitwise(state, six_steps(name)[0])


# --- what the shared loop does, shown on the cheapest learner ----------------------------------


@pytest.mark.parametrize(
    ("num_steps", "max_rows"), [(1, 1), (6, 6), (10, 4), (7, 3), (9, 1), (12, 5)]
)
def test_metrics_are_thinned_and_end_with_the_last_step(num_steps, max_rows):
    module, problem, hparams, _ = case("toy")
    state, metrics = module.run(
        start("toy"), problem, hparams, num_steps=num_steps, max_rows=max_rows
    )
    rows = metrics["at"].tolist()
    assert len(rows) <= max_rows
    assert rows[-1] == num_steps - 1
    assert len(set(np.diff(rows).tolist())) <= 1, "evenly spaced"
    every, all_metrics = module.run(start("toy"), problem, hparams, num_steps=num_steps)
    assert_bitwise(state, every)
    np.testing.assert_array_equal(metrics["x"], all_metrics["x"][metrics["at"]])


@pytest.mark.parametrize("limits", [{"num_steps": 0}, {"num_steps": 5, "max_rows": 0}])
def test_runs_have_at_least_one_step_and_row(limits):
    module, problem, hparams, _ = case("toy")
    with pytest.raises(ValueError, match="both must be at least 1"):
        module.run(start("toy"), problem, hparams, **limits)


def test_a_loop_of_lanes_is_a_while_loop():
    """Lanes of different lengths; what is given shared or not; nested."""
    def active(carry, given):
        return carry["n"] < given["most"]

    def body(carry, given):
        go = active(carry, given)
        return {"n": carry["n"] + go, "sum": carry["sum"].at[0].add(go * given["step"])}

    def loop(n, most, step):
        carry = {"n": n, "sum": jnp.zeros(2)}
        return learner.while_active(active, body, carry, {"most": most, "step": step})

    most = jnp.array([[3, 0, 7], [1, 5, 2]])
    step = jnp.array([1.0, 10.0])
    alone = loop(jnp.int32(1), most[0, 2], step[1])
    assert alone["n"] == 7 and alone["sum"].tolist() == [60.0, 0.0]
    inner = jax.vmap(loop, (None, 0, None))
    found = jax.jit(jax.vmap(inner, (None, 0, 0)))(jnp.int32(1), most, step)
    np.testing.assert_array_equal(found["n"], np.maximum(most, 1))
    np.testing.assert_array_equal(
        found["sum"][..., 0], (np.maximum(most, 1) - 1) * np.array([[1], [10]]))
    assert (found["sum"][..., 1] == 0).all()


def test_a_run_in_chunks_is_the_run():
    module, problem, hparams, _ = case("toy")
    reports = []
    state, metrics = learner.run_in_chunks(
        module.step, start("toy"), problem, hparams, num_steps=10, chunk=4,
        report=lambda done, row: reports.append((done, int(row["at"]))),
    )
    whole, all_metrics = module.run(start("toy"), problem, hparams, num_steps=10)
    assert_bitwise(state, whole)
    np.testing.assert_array_equal(metrics["x"], all_metrics["x"])
    assert reports == [(4, 3), (8, 7), (10, 9)]


def test_a_batch_of_seeds_runs_in_chunks():
    module, problem, hparams, _ = case("toy")
    keys = jax.random.split(jax.random.key(0), 3)
    states = jax.vmap(lambda k: module.init(k, problem, hparams))(keys)
    step = jax.vmap(toy_step, (0, None, None))
    states, _ = learner.run_in_chunks(step, states, problem, hparams, num_steps=5, chunk=2)
    alone, _ = module.train(keys[1], problem, hparams, num_steps=5)
    np.testing.assert_allclose(states.position[1], alone.position, rtol=1e-12)


def test_nested_states_with_keys_are_saved(tmp_path):
    def state(seed):
        key = jax.random.key(seed)
        return {"a/b": (jnp.arange(3) + seed, key), "a": {"b": jnp.float32(seed)}, "c": seed > 1}

    learner.save(tmp_path / "state.npz", state(3))
    assert_bitwise(learner.load(tmp_path / "state.npz", state(0)), state(3))


def damaged(path, name):
    if name == "empty":
        path.write_bytes(b"")
    elif name == "text":
        path.write_text("not an archive")
    else:
        learner.save(path, start("toy"))
        content = path.read_bytes()
        path.write_bytes(content[: len(content) // 2])


@pytest.mark.parametrize("name", ["empty", "text", "cut"])
def test_damaged_files_are_refused(name, tmp_path):
    path = tmp_path / "state.npz"
    damaged(path, name)
    with pytest.raises(ValueError, match=r"state\.npz' is not a saved state"):
        learner.load(path, start("toy"))


def test_missing_files_are_refused(tmp_path):
    with pytest.raises(ValueError, match=r"none\.npz' is not a saved state"):
        learner.load(tmp_path / "none.npz", start("toy"))


def test_a_changed_byte_is_noticed(tmp_path):
    path = tmp_path / "state.npz"
    learner.save(path, start("toy"))
    content = bytearray(path.read_bytes())
    place = content.find(np.asarray(start("toy").position).tobytes())
    content[place] ^= 1
    path.write_bytes(bytes(content))
    with pytest.raises(ValueError, match="is not a saved state"):
        learner.load(path, start("toy"))


def test_states_of_another_run_are_refused(tmp_path):
    path = tmp_path / "state.npz"
    learner.save(path, start("toy"))
    message = r"does not belong to this run: .*position is float64\[3\], expected float64\[4\]"
    with pytest.raises(ValueError, match=message):
        learner.load(path, toy_init(jax.random.key(0), jnp.zeros(4), 0.1))
    with pytest.raises(ValueError, match=r"does not belong to this run: .* is missing"):
        learner.load(path, start("mlirl-world"))
    module, problem, hparams, _ = case("mlirl-world")
    with pytest.raises(ValueError, match="Delete the file to start afresh"):
        learner.run_in_chunks(
            module.step, start("mlirl-world"), problem, hparams, num_steps=3, checkpoint=path
        )


def test_unwritable_places_are_refused(tmp_path):
    with pytest.raises(ValueError, match=r"cannot write .*none/state\.npz.*choose a directory"):
        learner.save(tmp_path / "none" / "state.npz", start("toy"))
    (tmp_path / "file").write_text("")
    with pytest.raises(ValueError, match="cannot write"):
        learner.save(tmp_path / "file" / "state.npz", start("toy"))


def test_a_write_that_fails_leaves_the_old_file(tmp_path, monkeypatch):
    path = tmp_path / "state.npz"
    learner.save(path, start("toy"))
    before = path.read_bytes()

    def fail(file, **arrays):
        file.write(b"half of it")
        raise OSError("no space left on device")

    monkeypatch.setattr(learner.np, "savez", fail)
    with pytest.raises(OSError, match="no space left"):
        learner.save(path, start("toy", seed=1))
    assert path.read_bytes() == before
    assert os.listdir(tmp_path) == ["state.npz"], "nothing half-written stays"


def test_an_interrupted_write_leaves_the_old_file(tmp_path):
    path = tmp_path / "file"
    path.write_bytes(b"old")
    with pytest.raises(KeyboardInterrupt), learner.atomic_write(path) as file:
        file.write(b"new")
        raise KeyboardInterrupt
    assert path.read_bytes() == b"old"
    assert os.listdir(tmp_path) == ["file"]
    with learner.atomic_write(path) as file:
        file.write(b"new")
        assert path.read_bytes() == b"old", "not before it is complete"
    assert path.read_bytes() == b"new"
