"""Trajectories that are given, and trajectories that are simulated."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxltl as jl
from tests import reference
from tests.support import REPRESENTATIONS, as_mdp, random_representation


def corridor():
    """Four cells in a row: action 0 moves on, action 1 stays and is missing in the first cell."""
    successor = [[[1], [0]], [[2], [1]], [[3], [2]], [[3], [3]]]
    available = [[True, False], [True, True], [True, True], [True, True]]
    return jl.make_mdp(successor, np.ones((4, 2, 1)), available=available, initial=[1, 0, 0, 0])


@pytest.mark.parametrize("dense", [False, True])
@pytest.mark.parametrize(
    ("sequences", "message"),
    [
        ([], "there are no trajectories"),
        ([[(0, 0)], []], "trajectory 1 is empty"),
        ([[(0, 0), (4, 0)]], "trajectory 0, step 1: state 4 does not exist; states are 0 to 3"),
        ([[(0, 0)], [(-1, 0)]], "trajectory 1, step 0: state -1 does not exist"),
        ([[(1, 2)]], r"trajectory 0, step 0: action 2 is not available in state 1; .* \[0, 1\]"),
        ([[(1, -1)]], "trajectory 0, step 0: action -1 is not available in state 1"),
        ([[(0, 1)]], r"trajectory 0, step 0: action 1 is not available in state 0; .* \[0\]"),
        (
            [[(0, 0), (1, 0)], [(0, 0), (1, 1), (2, 0)]],
            "trajectory 1, step 1: action 1 in state 1 cannot lead to state 2",
        ),
        ([[(1, 0), (0, 0)]], "trajectory 0, step 0: action 0 in state 1 cannot lead to state 0"),
    ],
)
def test_impossible_demonstrations_are_refused_at_their_step(sequences, message, dense):
    world = jl.models.to_dense(corridor()) if dense else corridor()
    with pytest.raises(ValueError, match=message):
        jl.make_trajectories(world, sequences)


def test_trajectories_are_padded():
    found = jl.make_trajectories(corridor(), [[(0, 0), (1, 1), (1, 0)], [(2, 0)]])
    assert found.state.tolist() == [[0, 1, 1], [2, 0, 0]]
    assert found.action.tolist() == [[0, 1, 0], [0, 0, 0]]
    assert found.length.tolist() == [3, 1]
    assert found.mask.tolist() == [[True] * 3, [True, False, False]]


def test_padding_is_no_successor():
    """A row of two successors in a table three wide does not lead to state 0."""
    world = jl.make_mdp([[[1, 0]], [[0, 1]]], [[[1.0, 0.0]], [[0.5, 0.5]]])
    with pytest.raises(ValueError, match="cannot lead to state 0"):
        jl.make_trajectories(world, [[(0, 0), (0, 0)]])


@pytest.mark.parametrize("kind", REPRESENTATIONS)
def test_rollouts_are_runs_of_the_model(kind):
    rng = np.random.default_rng(0)
    model, explicit = random_representation(rng, kind, certainty=0.1)
    policy = reference.random_policy(rng, explicit)
    runs = jl.rollout(
        model,
        jnp.asarray(policy.reshape(model.available.shape)),
        jax.random.key(0),
        num_trajectories=50,
        num_steps=12,
    )
    assert runs.state.shape == runs.action.shape == (50, 12)
    assert runs.length.tolist() == [12] * 50
    assert (explicit.initial[runs.state[:, 0]] > 0).all()
    assert (policy[runs.state, runs.action] > 0).all()
    s, a, t = runs.state[:, :-1], runs.action[:, :-1], runs.state[:, 1:]
    assert (explicit.transition[s, a, t] > 0).all()


@pytest.mark.slow
def test_rollouts_visit_as_the_occupancy_says():
    rng = np.random.default_rng(1)
    model = reference.random_model(rng, 4, 2, 2, 0.0)
    mdp, policy = as_mdp(model), jnp.asarray(reference.random_policy(rng, model))
    runs = jl.rollout(mdp, policy, jax.random.key(1), num_trajectories=5000, num_steps=25)
    weight = np.broadcast_to(0.5 ** np.arange(25), runs.state.shape) / 5000
    visits = np.zeros((4, 2))
    np.add.at(visits, (np.asarray(runs.state), np.asarray(runs.action)), weight)
    np.testing.assert_allclose(visits, jl.occupancy_measure(mdp, policy, 0.5).value, atol=0.03)


def test_rollouts_stop():
    policy = jnp.zeros(4, int)
    stop = jnp.array([False, False, True, False])

    def length(initial):
        world = corridor().replace(initial=jnp.asarray(initial, float))
        return jl.rollout(
            world, policy, jax.random.key(0), num_trajectories=2, num_steps=5, stop=stop
        )

    runs = length([1, 0, 0, 0])
    assert runs.length.tolist() == [2, 2], "the last pair enters the stopping state"
    assert runs.state.tolist() == [[0, 1, 0, 0, 0]] * 2
    assert length([0, 0, 1, 0]).length.tolist() == [0, 0]
    assert length([0, 0, 0, 1]).length.tolist() == [5, 5]


def test_rollouts_depend_on_the_key_alone():
    rng = np.random.default_rng(2)
    model = reference.random_model(rng, 5, 3, 2, 0.0)
    mdp, policy = as_mdp(model), jnp.asarray(reference.random_policy(rng, model))

    def run(key):
        return jl.rollout(mdp, policy, key, num_trajectories=8, num_steps=20)

    one, same, other = run(jax.random.key(0)), run(jax.random.key(0)), run(jax.random.key(1))
    np.testing.assert_array_equal(one.state, same.state)
    assert (np.asarray(one.state) != np.asarray(other.state)).any()
    assert len({tuple(row) for row in one.state.tolist()}) > 1, "trajectories differ"


def test_bad_policies_are_named():
    with pytest.raises(ValueError, match=r"policy has shape \(3,\)"):
        jl.rollout(
            corridor(), jnp.zeros(3, int), jax.random.key(0), num_trajectories=1, num_steps=1
        )


@pytest.mark.parametrize(
    "sequences, message",
    [
        (np.zeros((1, 2, 2)), r"step 0 is \[0.0, 0.0\]; give integers: \[\(int\(s\), int\(a\)\)"),
        ([[(0, 0), (1, 0.0)]], r"step 1 is \(1, 0.0\); give integers"),
        ([[(0, 0, 1), (1, 0, 1)]], r"step 0 is \(0, 0, 1\); give \(state, action\) alone"),
        ([[(0, 0), (1,)]], r"trajectory 0, step 1 is \(1,\); give a pair"),
        ([(0, 0)], "trajectory 0, step 0 is 0; give a pair"),
        ([[("a", "b")]], "step 0 is .'a', 'b'.; give a pair"),
    ],
)
def test_steps_are_pairs_of_integers(sequences, message):
    path = jl.make_mdp([[[1]], [[1]]], [[[1.0]], [[1.0]]])
    with pytest.raises(ValueError, match=message):
        jl.make_trajectories(path, sequences)
    pairs = np.array([[(0, 0), (1, 0)]])
    assert jl.make_trajectories(path, pairs).state.tolist() == [[0, 1]]


def test_rollouts_of_sparse_models_follow_the_names_of_actions():
    # State 0 has the choices "b" (to 1) and "a" (to 2); 1 and 2 return by "c".
    names = {"action": [1, 0, 2, 2], "action_names": ["a", "b", "c"]}
    model = jl.make_sparse(
        [0, 2, 3, 4], range(5), [1, 2, 0, 0], [1.0] * 4, initial=[1, 0, 0], **names
    )
    policy = jl.project_policy(model, np.array([1, 0, 0]))
    assert np.asarray(policy.action).tolist() == [[0], [2], [2]] and policy.actions == (
        "a",
        "b",
        "c",
    )
    weight = policy.replace(action=np.eye(3)[np.asarray(policy.action)])
    for given in (policy, weight, np.array([1, 0, 0])):
        runs = jl.rollout(model, given, jax.random.key(0), num_trajectories=1, num_steps=4)
        assert runs.state.tolist() == [[0, 2, 0, 2]]
    for wrong in (policy, weight):
        table = np.asarray(wrong.action)[[1, 0, 2]]
        with pytest.raises(ValueError, match=r"state 0 .*'b', 'a'"):
            jl.rollout(
                model,
                wrong.replace(action=table),
                jax.random.key(0),
                num_trajectories=1,
                num_steps=4,
            )
    # Names that do not tell the choices of a state apart are no numbers of a policy.
    alike = jl.make_sparse(
        [0, 2, 3, 4], range(5), [1, 2, 0, 0], [1.0] * 4, action=[0] * 4, action_names=[""]
    )
    policy = jl.project_policy(alike, np.array([1, 0, 0]))
    assert np.asarray(policy.action).tolist() == [[1], [0], [0]] and policy.actions == ()
