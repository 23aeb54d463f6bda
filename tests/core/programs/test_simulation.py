"""Simulated programs: steps against the rows of the built model, and laws of environments."""

import warnings

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.tree_util import Partial
from scipy import stats

from benchmarks import simulation
from jaxltl.core.environments.episodes import Agent, run_episode, with_time_limit
from jaxltl.core.environments.task_environment import task_environment
from jaxltl.core.language.resolve import read_program
from jaxltl.core.programs.build import build_model
from jaxltl.core.programs.simulation import list_choices, program_actions, program_environment

MAX_PROGRAMS = 600  # that the default tests compile at most

CHAIN = """dtmc global g : [0..2];
formula up = x<3 & b;
module m x : [0..3]; b : bool init true;
  [] up -> 0.2 : (x'=x+1) + 0.3 : (b'=false) + 0.5 : true;
  [go] x>0 -> x/4 : (x'=0) + (1-x/4) : (x'=x) & (b'=!b);
  [] x=3 -> (g'=mod(g+1,3));
endmodule
module n y : [-1..1]; [go] true -> 0.25 : (y'=y>0 ? -1 : y+1) + 0.75 : true;
  [] !up & x=0 -> 1/3 : (g'=2) + 2/3 : (y'=floor(y/2)) & (g'=0); endmodule
label "end" = x=3;
rewards "r" x=3 : 2; [go] true : 1 + y; [] y=0 : 0.5; endrewards"""

MDP = """mdp
module a x : [0..2]; [go] x<2 -> 0.25 : (x'=x+1) + 0.75 : true; [go] x=0 -> (x'=2);
  [back] x=2 -> 0.5 : (x'=0) + 0.5 : (x'=1); [go] x=1 -> (x'=0); endmodule
module b y : [0..2]; [go] y!=1 -> 0.5 : (y'=1) + 0.5 : true; [] y=1 -> 0.1 : (y'=0) + 0.9 : (y'=2);
  [back] y=2 -> (y'=y); endmodule
init x=0 & y<2 endinit
label "top" = x=2;
rewards [go] true : 3; x=1 : 1; [] true : y; endrewards"""


def worlds_of(model):
    """All states of a model as one batch of worlds."""
    return {
        name: jnp.asarray(x if x.dtype == bool else x.astype(np.int32))
        for name, x in model.valuation.items()
    }


def index_of(model, worlds):
    """The state of each world of a batch."""
    names = list(model.valuation)
    state = {tuple(int(model.valuation[n][s]) for n in names): s for s in range(model.num_states)}
    table = np.stack([np.asarray(worlds[n]).ravel().astype(int) for n in names], 1)
    return np.array([state[tuple(row)] for row in table.tolist()])


def row_law(model, row):
    law = np.zeros(model.num_states)
    entries = slice(model.entry_start[row], model.entry_start[row + 1])
    np.add.at(law, np.asarray(model.successor[entries]), np.asarray(model.probability[entries]))
    return law


@pytest.mark.parametrize("text", [CHAIN, MDP])
def test_frequencies_of_steps_are_those_of_the_built_model(text):
    """Chi-square of each state and choice; level 1e-4 in all, by Bonferroni."""
    program = read_program(text)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)
        model = build_model(program)
    environment = program_environment(program)
    chain = program.kind == "dtmc"
    actions, size, draws = environment.actions.num, model.num_states, 4000
    keys = jax.random.split(jax.random.key(7), (actions, size, draws))
    step = jax.jit(
        jax.vmap(jax.vmap(jax.vmap(environment.step, (None, None, 0)), (0, None, 0)), (None, 0, 0))
    )
    worlds = worlds_of(model)
    successor = index_of(model, step(worlds, jnp.arange(actions), keys).world)
    successor = successor.reshape(actions, size, draws)
    pairs = []
    for s in range(size):
        rows = list(range(model.row_start[s], model.row_start[s + 1]))
        world = {name: x[s] for name, x in worlds.items()}
        able = np.ones(1, bool) if chain else np.asarray(environment.allowed(world))
        if chain:
            assert len(rows) == 1
        names = [model.action_names[model.action[r]] for r in rows]
        choices = list_choices(program)[1]
        mine = [choices[a].action for a in np.flatnonzero(able)]
        if not chain and sum(able) == len(rows) and sorted(mine) == sorted(names):
            for name in set(names):  # choices of one action, in any order
                a_some = [a for a in np.flatnonzero(able) if choices[a].action == name]
                r_some = [r for r, n in zip(rows, names, strict=True) if n == name]
                count = [np.bincount(successor[a, s], minlength=size) / draws for a in a_some]
                for r in r_some:
                    i = int(np.argmin([abs(c - row_law(model, r)).sum() for c in count]))
                    pairs.append((s, a_some.pop(i), r))
                    count.pop(i)
        else:  # a deadlock, or a chain
            assert chain or (able[0] and sum(able) == 1 and len(rows) == 1)
            pairs.append((s, 0, rows[0]))
    assert len(pairs) == model.num_rows
    for s, a, r in pairs:
        law, count = row_law(model, r), np.bincount(successor[a, s], minlength=size)
        assert not count[law == 0].any()
        if (law > 0).sum() > 1:
            some = law > 0
            p = stats.chisquare(count[some], draws * law[some]).pvalue
            assert p > 1e-4 / len(pairs), (s, a, r, count[some], draws * law[some])


@pytest.mark.few(1)
@pytest.mark.parametrize(("text", "reward"), [(CHAIN, "r"), (MDP, "")])
def test_rewards_and_labels_are_those_of_the_built_model(text, reward):
    program = read_program(text)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)
        model = build_model(program)
    environment = program_environment(program, reward=reward)
    worlds = worlds_of(model)
    label = jax.vmap(environment.labels)(worlds)
    column = model.propositions.index(environment.propositions[0])
    np.testing.assert_array_equal(label[:, 0], model.label[:, column])
    parts = model.rewards[reward]
    keys = jax.random.split(jax.random.key(3), (model.num_states, 3000))
    for a in range(environment.actions.num):
        step = jax.vmap(jax.vmap(environment.step, (None, None, 0)), (0, None, 0))
        mean = np.asarray(step(worlds, a, keys).reward).mean(1)
        for s in range(model.num_states):
            rows = range(model.row_start[s], model.row_start[s + 1])
            world = {n: x[s] for n, x in worlds.items()}
            if environment.allowed is not None and not environment.allowed(world)[a]:
                continue
            name = None if program.kind == "dtmc" else list_choices(program)[1][a].action
            choice = [
                parts.choice[r]
                for r in rows
                if name is None or model.action_names[model.action[r]] in (name, "")
            ]
            gaps = [abs(parts.state[s] + c - mean[s]) for c in choice]
            assert min(gaps) < (0.1 if name is None else 1e-6), (s, a)


def test_commands_that_exclude_each_other_share_an_action():
    program = read_program("""mdp const int N=100;
    module m x : [0..N]; b : bool; [a] x<5 & b -> true; [a] x>=5 -> true; [a] !b & x<9 -> true;
      [] b & x!=3 -> true; [] x=3 -> true; [] !(b & x!=3) -> true; endmodule
    module n y : [0..N]; z : [0..N]; [a] y<z -> true; [a] y>=z -> true; endmodule""")
    # x and b exclude [a] 1 from [a] 2 and 3; y and z have too many values together.
    assert program_actions(program) == ("m 1", "m 2", "a 1", "a 2", "a 3", "a 4")


def test_an_environment_has_its_parts():
    program = read_program(MDP)
    environment = program_environment(program, labels=["deadlock", "top"])
    worlds, probability = environment.starts()
    assert worlds["y"].tolist() == [0, 1] and probability.tolist() == [0.5, 0.5]
    drawn = jax.vmap(environment.reset)(jax.random.split(jax.random.key(0), 200))
    assert set(np.asarray(drawn["y"]).tolist()) == {0, 1}
    stuck = {"x": jnp.int32(2), "y": jnp.int32(0)}
    assert environment.labels(stuck).tolist() == [True, True]
    assert environment.allowed(stuck).tolist()[0] and sum(environment.allowed(stuck)) == 1
    after = environment.step(stuck, 0, jax.random.key(0))
    assert jax.tree.map(int, after.world) == {"x": 2, "y": 0} and not after.terminated
    other = jnp.argmin(environment.allowed(drawn | {"x": jnp.int32(1), "y": jnp.int32(1)}))
    world = {"x": jnp.int32(1), "y": jnp.int32(1)}
    assert jax.tree.map(int, environment.step(world, other, jax.random.key(0)).world) == {
        "x": 1,
        "y": 1,
    }
    np.testing.assert_allclose(environment.observe(world), [0.5, 0.5])


def test_tasks_and_time_limits_take_the_environment_of_a_program():
    environment = program_environment(read_program(MDP))
    task = with_time_limit(task_environment(environment, "F top"), 40)
    agent = Agent(Partial(lambda memory, seen, allowed, key: (jnp.argmax(allowed), memory)))
    episode = run_episode(jax.random.key(0), task, agent, num_steps=40)
    assert episode.terminated and episode.reward.sum() == 1
    assert episode.label[:, 0].argmax() == episode.valid.sum()  # ends in the first state with top


@pytest.mark.parametrize("divisor", [7, 41, 194])
def test_floors_of_quotients_are_exact(divisor):
    """Multiplication by the reciprocal of 41 gives floor(41/41) = 0 in single precision."""
    program = read_program(
        "dtmc const int d; module m x : [0..999]; q : [0..999]; "
        "[] true -> (q'=floor(x/d)) & (x'=min(x+1,999)); endmodule",
        {"d": divisor},
    )
    environment = program_environment(program)
    x = jnp.arange(1000, dtype=jnp.int32)
    worlds = {"x": x, "q": jnp.zeros_like(x)}
    step = jax.jit(jax.vmap(lambda w: environment.step(w, 0, jax.random.key(0))))
    np.testing.assert_array_equal(step(worlds).world["q"], np.arange(1000) // divisor)


def test_invalid_updates_have_the_reward_nan():
    program = read_program("""dtmc module m x : [0..3]; [] x<2 -> 0.5 : (x'=x-1) + 0.5 : (x'=x+1);
    [] x>=2 -> x/2 : (x'=0); endmodule""")
    environment = program_environment(program)
    keys = jax.random.split(jax.random.key(0), 64)

    def steps(x):
        return jax.vmap(lambda k: environment.step({"x": jnp.int32(x)}, 0, k))(keys)

    found = steps(0)
    assert set(np.asarray(found.world["x"]).tolist()) == {0, 1}
    np.testing.assert_array_equal(np.isnan(found.reward), found.world["x"] == 0)
    assert not np.isnan(steps(1).reward).any() and not np.isnan(steps(2).reward).any()
    assert np.isnan(steps(3).reward).all()


def test_an_outcome_of_probability_zero_never_happens():
    program = read_program("""dtmc module m x : [0..3]; z : [0..1];
    [] true -> 1/3 : (x'=1) + 1/3 : (x'=2) + 1/3 : (x'=3) + z/9 : (x'=0); endmodule""")
    step = jax.vmap(program_environment(program).step, (None, None, 0))
    world = {"x": jnp.int32(1), "z": jnp.int32(0)}
    found = jax.jit(step)(world, 0, jax.random.split(jax.random.key(1), 2**18))
    assert np.asarray(found.world["x"]).min() == 1


PLAYERS = "player p m endplayer"


@pytest.mark.parametrize(
    ("text", "options", "message"),
    [
        (f"smg {PLAYERS} module m x : bool; [] true -> true; endmodule", {}, "an smg is not"),
        ("dtmc module m x : bool; [] true -> [.1,.5] : true + [.5,.9] : (x'=!x); endmodule", {},
         "intervals"),
        ("dtmc const double p; module m x : bool; [] true -> p : true + 1-p : (x'=!x); endmodule",
         {}, "constant p has no value"),
        ("dtmc module m x : bool; endmodule", {}, "no commands"),
        (MDP, {"reward": "cost"}, r"no reward structure 'cost'; there are \[''\]"),
        (MDP, {"labels": ["goal"]}, r"no label 'goal'; there are \['deadlock', 'top'\]"),
        ("dtmc module m x : [0..3000000000]; [] true -> true; endmodule", {}, "line 1.*32-bit"),
        ("dtmc module m x : [0..65536]; [] x*x>x -> true; endmodule", {}, "32-bit"),
        ("mdp module m x : [0..9]; y : [0..9999]; "
         + "".join(f"[a] y!={i} -> true; " for i in range(70)) + "endmodule module n = m [x=u, y=v] "
         "endmodule", {}, "4900 choices, more than 4096"),
    ],
)  # fmt: skip
def test_what_has_no_simulation_is_refused(text, options, message):
    with pytest.raises(ValueError, match=message) as error:
        program_environment(read_program(text), **options)
    assert "\n" not in str(error.value)


WHEEL = """mdp module m x : [0..6]; [a] true -> 0.3 : (x'=mod(x+1, 7)) + 0.7 : true;
  [] x>2 -> x/10 : (x'=0) + 1 - x/10 : (x'=x-1); [] x=4 -> (x'=1); endmodule
module n y : [0..3]; b : bool; [a] y<3 -> 0.1 : (y'=y+1) + 0.9 : (b'=!b); [a] b -> (y'=0);
  [] y=3 & !b -> (b'=true); endmodule"""


@pytest.mark.slow
def test_frequencies_of_many_steps_pass_a_chi_square_test(monkeypatch):
    program = read_program(WHEEL)
    assert min(simulation.p_values(program, 2, lanes=500, steps=2000)) > 0.001
    other = build_model(read_program(WHEEL.replace("0.3", "0.31").replace("0.7", "0.69")))
    monkeypatch.setattr(simulation.jl.io, "build_model", lambda _: other)
    assert simulation.p_values(program, 1)[0] < 1e-6
