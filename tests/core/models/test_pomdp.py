"""Partially observable models: construction, programs, refusals, and simulation."""

import jax
import numpy as np
import pytest

import jaxltl as jl
from jaxltl.core.language.resolve import read_program
from jaxltl.core.models.pomdp import policy_of_states
from jaxltl.core.programs.build import build_model
from jaxltl.core.programs.partial import solve_program
from jaxltl.core.programs.simulation import program_environment

LAMP = """
pomdp
observables on endobservables
observable "late" = t > 1;
module lamp
  hidden : bool init false;
  on : bool init false;
  t : [0..3] init 0;
  [stay] t < 3 -> 0.5 : (hidden'=!hidden) & (t'=t+1) + 0.5 : (t'=t+1);
  [guess] t < 3 -> (on'=hidden) & (t'=3);
  [stay] t = 3 -> true;
  [guess] t = 3 -> true;
endmodule
label "on" = on;
rewards "stays" [stay] t < 3 : 1; endrewards
"""


@pytest.fixture(scope="module")
def lamp():
    return build_model(read_program(LAMP))


def test_observations_are_tuples_of_observables(lamp):
    world = lamp.fully_observable
    seen = np.asarray(lamp.observation)
    for name, of_state in (("on", world.valuation["on"]), ("late", world.valuation["t"] > 1)):
        np.testing.assert_array_equal(lamp.observables[name][seen], of_state)
    pairs = {(bool(a), bool(b)) for a, b in zip(*lamp.observables.values(), strict=True)}
    assert len(pairs) == lamp.num_observations == 3


def test_rows_are_in_the_order_of_actions_and_keep_their_rewards(lamp):
    world = lamp.fully_observable
    names = np.asarray(world.action_names)[np.asarray(world.action)].reshape(-1, 2)
    assert (names == [["stay", "guess"]]).all() or (names == [["guess", "stay"]]).all()
    earned = jl.models.choice_reward(world, "stays")
    stays = (names.ravel() == "stay") & (world.valuation["t"][world.host.state] < 3)
    np.testing.assert_array_equal(earned, stays.astype(float))


def test_unsorted_rows_are_sorted_with_their_entries():
    # State 0 lists action 1 before action 0, and state 1 the other way round.
    world = jl.make_sparse(
        [0, 2, 4],
        [0, 1, 2, 3, 4],
        [0, 1, 0, 1],
        [1.0, 1, 1, 1],
        action=[1, 0, 0, 1],
        rewards={"r": jl.models.Rewards(choice=[7, 5, 2, 3], transition=[70, 50, 20, 30])},
    )
    pomdp = jl.models.make_pomdp(world, [0, 0])
    model = pomdp.fully_observable
    assert model.successor.tolist() == [1, 0, 0, 1] and model.action_number.tolist() == [0, 1, 0, 1]
    assert model.rewards["r"].choice.tolist() == [5, 7, 2, 3]
    assert model.rewards["r"].transition.tolist() == [50, 70, 20, 30]
    assert pomdp.row_of_action.tolist() == [[0, 1], [2, 3]]


def test_states_of_equal_observation_have_equal_actions():
    world = jl.make_sparse([0, 2, 3], [0, 1, 2, 3], [0, 1, 1], [1.0, 1, 1])
    with pytest.raises(ValueError, match="states 0 and 1 have the observation 0"):
        jl.models.make_pomdp(world, [0, 0])
    assert jl.models.make_pomdp(world, [0, 1]).available.tolist() == [[True, True], [True, False]]
    named = jl.make_sparse(
        None, [0, 1, 2], [0, 1], [1.0, 1], action=[0, 1], action_names=["left", "right"]
    )
    with pytest.raises(ValueError, match=r"left.*right"):
        jl.models.make_pomdp(named, [0, 0])


@pytest.mark.parametrize(
    ("observation", "text"),
    [
        ([0], "shape|int64"),
        ([0.0, 1.0], "float64"),
        ([0, -1], r"observation\[1\]"),
        ([0, 2], "at most 1"),
    ],
)
def test_wrong_observations(observation, text):
    world = jl.make_sparse(None, [0, 1, 2], [0, 1], [1.0, 1])
    with pytest.raises(ValueError, match=text):
        jl.models.make_pomdp(world, observation)


def test_other_models_are_refused():
    world = jl.make_sparse(None, [0, 1, 2], [0, 1], [1.0, 1])
    for model in (jl.make_game(world, [True, False]), jl.models.make_pomdp(world, [0, 0]), None):
        with pytest.raises(ValueError, match="make_pomdp"):
            jl.models.make_pomdp(model, [0, 0])
    with pytest.raises(ValueError, match="observables"):
        jl.models.make_pomdp(world, [0, 0], observables={"x": [1, 2]})


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("pomdp module m x : [0..1]; [] true -> true; endmodule", "no observables"),
        (
            "mdp observables x endobservables module m x : [0..1]; [] true -> true; endmodule",
            "only a pomdp",
        ),
        (
            "pomdp observables x, x endobservables module m x : [0..1]; [] true -> true; endmodule",
            "twice",
        ),
        ("pomdp observables y endobservables module m x : [0..1]; [] true -> true; endmodule", "y"),
        (
            "pomdp observables x endobservables module m x : [0..1]; "
            "[] true -> [0.1, 0.9] : (x'=0) + [0.1, 0.9] : (x'=1); endmodule",
            "intervals",
        ),
    ],
)
def test_programs_that_are_refused(text, message):
    with pytest.raises(ValueError, match=message):
        build_model(read_program(text))


MASK = np.ones(8, bool)
CALLS = {
    "average_reward": lambda m: jl.average_reward(m, "stays"),
    "hitting_time": lambda m: jl.values.hitting_time(m, MASK),
    "next_probability": lambda m: jl.values.next_probability(m, MASK),
    "product": lambda m: jl.product(m, "F on"),
    "to_sparse": jl.to_sparse,
    "to_padded": jl.to_padded,
    "to_dense": jl.models.to_dense,
    "winning_region": lambda m: jl.winning_region(m, "F on"),
    "permissive_strategy": lambda m: jl.permissive_strategy(m, "F on"),
    "make_game": lambda m: jl.make_game(m, MASK),
    "make_interval": lambda m: jl.make_interval(m, MASK, MASK),
    "prepare": jl.prepare,
    "optimal_actions": lambda m: jl.optimal_actions(m, "F on"),
    "constrained_optimum": lambda m: jl.constrained_optimum(m, ["F on"]),
    "pareto": lambda m: jl.pareto(m, ["F on"]),
    "task_performance": lambda m: jl.task_performance(m, MASK),
    "soft_value": lambda m: jl.values.soft_value(m, MASK, 0.9),
    "occupancy_measure": lambda m: jl.occupancy_measure(m, np.ones((8, 2)) / 2, 0.9),
    "with_allowed": lambda m: jl.with_allowed(m, MASK),
    "choice_reward": lambda m: jl.models.choice_reward(m, "stays"),
    "write_model": lambda m: jl.io.write_model("pomdp.tra", m),
    "solve_program": lambda m: solve_program(read_program(LAMP), "P=? [ F on ]", method="partial"),
    "program_environment": lambda m: program_environment(read_program(LAMP)),
}


@pytest.mark.parametrize("call", CALLS.values(), ids=list(CALLS))
def test_functions_of_models_whose_states_are_seen_refuse_a_pomdp(call, lamp):
    with pytest.raises(ValueError, match=r"POMDP|pomdp"):
        call(lamp)


def test_environment_shows_observations_alone(lamp):
    env = jl.environments.model_environment(lamp, reward="stays")
    assert env.observations.shape == (lamp.num_observations,)
    for state in range(lamp.num_states):
        assert int(np.argmax(env.observe(state))) == lamp.observation[state]
    timestep = env.step(np.int32(0), np.int32(0), jax.random.key(0))
    assert int(timestep.world) in range(lamp.num_states)


def test_controllers_are_named_saved_loaded_and_simulated(lamp, tmp_path):
    answer = jl.values.belief_bounds(lamp, "on")
    policy = answer.policy
    assert set(policy.actions) == {"stay", "guess"}
    assert policy.states[lamp.observation[0]] == "on=False, late=False"
    jl.io.save_policy(tmp_path / "lamp.npz", policy)
    loaded = jl.io.load_policy(tmp_path / "lamp.npz")
    assert loaded.states == policy.states and loaded.actions == policy.actions
    again = jl.reachability_probability(lamp, "on", policy=loaded)
    assert float(again.lower) == pytest.approx(float(answer.value), abs=1e-6)
    robot = loaded.controller()
    robot.start(policy.states[lamp.observation[0]])
    assert robot.act() in (0, 1)
    # A rollout acts as the robot does, and reaches the label as often as is certified.
    key = jax.random.key(0)
    seen = jl.rollout(lamp, loaded, key, num_trajectories=2000, num_steps=6)
    reached = np.asarray(lamp.label)[np.asarray(seen.state)].any((1, 2)).mean()
    assert abs(reached - float(answer.value)) < 5 * 0.5 / np.sqrt(2000)
    of_states = policy_of_states(lamp, loaded)
    assert of_states.num_states == lamp.num_states
    np.testing.assert_array_equal(of_states.action, loaded.action[np.asarray(lamp.observation)])
    for wrong in (of_states, np.zeros(4, int)):
        with pytest.raises(ValueError, match=r"whose states are the 3 observations"):
            jl.rollout(lamp, wrong, key, num_trajectories=1, num_steps=1)


def test_action_names_that_depend_on_the_observation_are_left_out():
    world = jl.make_sparse(
        [0, 2, 4],
        [0, 1, 2, 3, 4],
        [0, 1, 0, 1],
        [1.0, 1, 1, 1],
        action=[0, 1, 1, 2],
        action_names=("a", "b", "c"),
    )
    pomdp = jl.models.make_pomdp(world, [0, 1])
    assert pomdp.action_names == () and pomdp.observation_names == ()
