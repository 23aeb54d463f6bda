"""Random models with all that files can hold, and when two models are the same."""

from dataclasses import replace

import numpy as np
import pytest

from jaxltl.core.models.interval import IntervalMDP, make_interval
from jaxltl.core.models.pomdp import POMDP, make_pomdp
from jaxltl.core.models.sparse import Rewards, SparseMDP, make_sparse
from tests.sparse_models import random_sparse

PARTS = ("state", "choice", "transition")
NAMES = ("a", "goal", "some_label", "Bad2", "deadlock")


def full_model(rng, num_states=9, *, chain=False, transition_rewards=True, names=NAMES):
    """A random model with labels, rewards, named actions, variables and initial states."""
    model = random_sparse(rng, num_states, chain=chain)
    initial = rng.random(num_states) < 0.3
    initial[rng.integers(num_states)] = True
    label = rng.random((num_states, len(names))) < 0.3
    label[rng.integers(num_states, size=len(names)), np.arange(len(names))] = True
    numbers = [10.0 ** rng.integers(-300, 300), -0.1, 1 / 3, 5e-324, 2.0**60, np.inf]

    def some(size):
        found = np.where(rng.random(size) < 0.5, rng.choice(numbers, size), rng.random(size))
        found[rng.random(size) < 0.3] = 0
        found[0] = 0.7
        return found

    rewards = {
        "cost": Rewards(state=some(num_states)),
        "time": Rewards(state=some(num_states), choice=some(model.num_rows)),
        "r_3": Rewards(choice=some(model.num_rows)),
    }
    if transition_rewards:
        rewards["steps"] = Rewards(transition=some(model.num_transitions))
    action = rng.integers(0, 3, model.num_rows)
    return replace(
        model,
        initial=initial / initial.sum(),
        label=label,
        propositions=tuple(names),
        rewards=rewards,
        action=action.astype(np.int32),
        action_names=("go", "", "_wait"),
        valuation={
            "x": rng.integers(-5, 5, num_states),
            "b": rng.random(num_states) < 0.5,
            "y": rng.random(num_states),
        },
    )


def full_interval(rng, num_states=9, **options):
    """The same with intervals: points, lower ends of 0, whole rows that are open."""
    model = full_model(rng, num_states, **options)
    p = model.probability
    lower, upper = p * rng.random(p.size), p + (1 - p) * rng.random(p.size)
    kind = rng.integers(4, size=p.size)
    lower = np.where(kind == 0, 0, np.where(kind == 1, p, lower))
    upper = np.where(kind == 1, p, np.where(rng.random(p.size) < 0.1, 1, upper))
    return make_interval(model, lower, upper)


def assert_same_interval(found: IntervalMDP, model: IntervalMDP, **options):
    """The same ends bit for bit, and the same model."""
    assert isinstance(found, IntervalMDP)
    assert found.lower.tobytes() == model.lower.tobytes()
    assert found.upper.tobytes() == model.upper.tobytes()
    assert_same(found.nominal, model.nominal, **options)


def assert_same(found: SparseMDP, model: SparseMDP, *, valuation=True):
    """The same bits; names may be numbered otherwise, and rewards that are zero be left out."""
    for name in ("row_start", "entry_start", "successor", "probability", "initial"):
        a, b = getattr(found, name), getattr(model, name)
        assert a.dtype == b.dtype and a.tobytes() == b.tobytes(), name
    assert set(found.propositions) == set(model.propositions)
    for name in model.propositions:
        np.testing.assert_array_equal(found.states_with_label(name), model.states_with_label(name))
    assert actions(found) == actions(model)
    assert list(found.rewards) == list(model.rewards)
    for name, reward in model.rewards.items():
        for part in PARTS:
            a, b = getattr(found.rewards[name], part), getattr(reward, part)
            if b is None or not b.any():
                assert a is None or not a.any(), (name, part)
            else:
                assert a is not None and a.tobytes() == b.tobytes(), (name, part)
    if valuation:
        assert list(found.valuation) == list(model.valuation)
        for name, values in model.valuation.items():
            assert found.valuation[name].dtype == values.dtype
            assert found.valuation[name].tobytes() == values.tobytes()


def actions(model: SparseMDP) -> list:
    """The name of each choice's action, or its number if it has none."""
    if model.action is None:
        return []
    return [model.action_names[i] if model.action_names else int(i) for i in model.action]


def refuses(write, path, model, more):
    """A writer of an explicit format refuses a model of nine states with each of these parts.

    Args:
      write: the writer.
      path: of the file, alone in its folder.
      model: what can be written.
      more: other parts that cannot, by what is said of them.
    """
    wrong = {
        "not equally likely": {"initial": np.r_[0.25, 0.75, np.zeros(7)]},
        "the action 'a b' cannot": {"action_names": ("a b", "b", "c")},
        "the label 'a\"b' cannot": {"propositions": ('a"b', *model.propositions[1:])},
        "another of this name": {"propositions": ("init", *model.propositions[1:])},
    }
    for message, parts in (wrong | more).items():
        with pytest.raises(ValueError, match=message):
            write(path, replace(model, **parts))
    assert not list(path.parent.iterdir())


def random_pomdp(rng, num_states=8, *, all_actions=False, begins=None):
    """A random POMDP with four observations, named actions, labels, rewards and observables."""
    number = np.arange(num_states) % 4
    sets = [np.sort(rng.choice(3, size=rng.integers(1, 4), replace=False)) for _ in range(4)]
    if all_actions:
        sets = [np.arange(3)] * 4
    action = np.concatenate([sets[o] for o in number])
    size = action.size
    width = rng.integers(1, 4, size)
    successor = np.concatenate([rng.choice(num_states, k, replace=False) for k in width])
    chance = np.concatenate([rng.dirichlet(np.ones(k)) for k in width])
    start = np.concatenate([[0], np.cumsum(width)])
    initial = (np.arange(num_states) < 3) if begins is None else number == begins
    world = make_sparse(
        np.concatenate([[0], np.cumsum([sets[o].size for o in number])]),
        start,
        successor,
        chance,
        initial=initial / initial.sum(),
        label=(rng.random((num_states, 2)) < 0.5) | (np.arange(num_states) == 1)[:, None],
        propositions=("a", "b"),
        action=action,
        action_names=("left", "right", "stay"),
        rewards={
            "cost": Rewards(state=rng.random(num_states), choice=rng.random(size)),
            "steps": Rewards(transition=rng.random(chance.size)),
        },
        valuation={"x": rng.integers(0, 9, num_states).astype(np.int32)},
    )
    observables = {"seen": np.arange(4, dtype=np.int32), "name": np.array(list("abcd"))}
    return make_pomdp(world, number, observables=observables)


def assert_same_pomdp(found: POMDP, pomdp: POMDP, *, whole=True):
    """The same observations and actions, and the same model; with the variables if `whole`."""
    assert isinstance(found, POMDP)
    assert found.observation.tolist() == pomdp.observation.tolist()
    assert found.row_of_action.tolist() == pomdp.row_of_action.tolist()
    assert_same(found.fully_observable, pomdp.fully_observable, valuation=whole)
    assert list(found.observables) == (list(pomdp.observables) if whole else [])
    for name, values in found.observables.items():
        assert values.tolist() == pomdp.observables[name].tolist()
