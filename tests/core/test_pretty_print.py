"""Objects in a few lines: what is told of each, and that nothing is too large or strange for it."""

import dataclasses
import importlib
import pickle
import pkgutil
import re
import sys
import typing
import warnings
from functools import cache, partial
from types import SimpleNamespace
from xml.etree import ElementTree

import jax
import jax.numpy as jnp
import matplotlib
import numpy as np
import pytest
from jax.sharding import NamedSharding, PartitionSpec

import jaxltl as jl
from jaxltl import algos, core, envs
from jaxltl.algos import behavioral_cloning, cce, mlirl, ppo
from jaxltl.algos.common.schedules import Linear
from jaxltl.core import pretty_print as show

MAP = """
. . . r .
. g . r .
. . . # .
s . r . y
"""


def lines_of(value) -> list[str]:
    text = repr(value)
    lines = text.split("\n")
    assert len(lines) <= show.LINES, text
    assert max(map(len, lines)) <= show.WIDTH, text
    return lines


def told(value) -> str:
    return " ".join(line.strip() for line in lines_of(value))


@cache
def made():
    """Objects by their class, all made on the host."""
    world = jl.gridworld(MAP, slip=0.1, absorbing=["y"], initial="s")
    automaton = jl.to_automaton("!r U y")
    product = jl.product(world, automaton)
    coin = jl.make_sparse(
        [0, 2, 3, 4],
        [0, 2, 4, 5, 6],
        [0, 1, 0, 2, 1, 2],
        [0.5, 0.5, 0.9, 0.1, 1.0, 1.0],
        initial=[1, 0, 0],
        label={"done": [1, 2], "lost": [2]},
        rewards={"steps": jl.models.Rewards(state=np.array([1.0, 0, 0]))},
    )
    rough = jl.make_interval(coin, [0.4, 0.4, 0.8, 0.0, 1, 1], [0.6, 0.6, 1.0, 0.2, 1, 1])
    solution = jl.reachability_probability(coin, coin.states_with_label("lost"))
    counts = jl.make_counts([0, 1, 0], [0, 0, 0], [1, 1, 0], [880, 5, 120], states=["dock", "bay"])
    game = jl.envs.grid_game("a.\n.b")
    region = np.arange(32) < 20
    objective = jl.games.Parity(np.zeros(32, np.int32), region, ~region, 2)
    estimate = jl.values.Estimate(0.5, 0.25, 0.75, 0.01, "exact")
    evaluation = jl.values.Evaluation(
        estimate,
        None,
        None,
        estimate,
        None,
        estimate,
        estimate,
        None,
        None,
        900,
        100,
        0,
        1000,
        50,
        0.95,
        0.5,
        None,
        None,
        jl.Status.MAX_STEPS,
    )
    box = jl.environments.make_box(-1.0, [1.0, 2.0])
    environment = jl.make_environment(
        partial(_start),
        partial(_step),
        partial(_see),
        actions=3,
        observations=box,
        propositions=(),
        horizon=7,
    )
    satisfaction = jl.optimal_satisfaction(coin, "F lost")
    sure = jl.statistics.ConfidenceSets(
        np.zeros(3),
        np.array([0.5, 0.25, 1]),
        np.zeros(3),
        None,
        np.zeros(2),
        np.array([6, 9]),
        3,
        0.95,
        "anytime",
    )
    found = [
        world,
        jl.models.to_dense(world),
        automaton,
        product,
        coin,
        coin.rewards["steps"],
        rough,
        solution,
        counts,
        game,
        objective,
        estimate,
        evaluation,
        box,
        environment,
        satisfaction.product_policy,
        sure,
        jl.environments.make_monitor(automaton),
        jl.make_trajectories(world, [[(15, 0), (10, 0)], [(15, 3)]]),
        jl.FiniteMemoryPolicy(
            np.zeros((20, 3), np.int32), np.zeros(20, np.int32), np.zeros((20, 3), np.int32)
        ),
        jl.games.GR1(np.ones((2, 32), bool), np.ones((3, 32), bool), ~region),
        jl.games.Winning(game, objective, region, np.zeros(32, np.int32), np.zeros(32, np.int32)),
        jl.games.Permissive(
            game,
            region,
            np.ones((32, 5), bool),
            np.arange(32),
            np.zeros(32),
            True,
            "maximal: it includes all",
        ),
        jl.games.Verification(False, True, "state 3 loses"),
        jl.values.Answer(
            np.array([0]),
            np.array([0.5]),
            np.array([0.5]),
            np.array([0.5001]),
            [None],
            jl.Status.PRECISION,
            "levels",
            None,
        ),
        jl.values.OptimalActions(
            np.ones((20, 3, 4), bool),
            np.ones((20, 3, 4)),
            solution,
            solution,
            np.float32(1e-7),
            np.int32(0),
        ),
        jl.values.OptimalityGap(
            np.arange(2),
            np.ones(2),
            solution,
            solution,
            np.zeros(2),
            np.array([0, 0.1]),
            (0.0, 0.05),
            (0.9, 0.9),
            (0.9, 0.95),
            "keyless",
        ),
        jl.values.DataGuarantee(0.9, 0.95, 0.99, satisfaction, rough, sure, np.zeros(4), "given"),
        jl.environments.TabulatedEnvironment(
            coin, np.arange(3), np.zeros(1, int), np.zeros(3, bool), np.ones(3, bool), 9
        ),
        jl.ParametricMDP(coin, None, np.zeros(2), np.ones(2), np.ones(2) / 2, ("p", "q")),
        jl.values.Objective(formula="F a", threshold=0.5),
        jl.logic.parse_property('P>=0.5 [ F "a" ]'),
        jl.models.ModelPart(
            np.arange(3), np.zeros(2, int), np.ones(2), rewards={"cost": np.ones(2)}
        ),
        jl.environments.TaskWorld(
            np.zeros(2), np.int32(1), np.int32(2), np.bool_(True), np.int32(3)
        ),
        jl.environments.Episode(
            *[np.zeros((4, 5))] * 6,
            np.tri(4, 5, 1, bool),
            np.ones(4, bool),
            np.zeros(4, bool),
            np.ones((4, 5)),
        ),
    ]
    return {type(x).__name__: x for x in found}


def _start(key):
    return jnp.zeros(2)


def _step(world, action, key):
    return jl.environments.Timestep(world, reward=1.0, terminated=world[0] > 3)


def _see(world):
    return world


TEXTS = {
    "MDP": "successor=int32[20, 4, 3] from 0 to 19, propositions=('g', 'r', 's', 'y')",
    "Automaton": "acceptance='cosafe', delta=int32[3, 4] from 0 to 2, state_names=('!r U y',",
    "Product": "mdp=MDP(successor=int32[20, 4, 3], automaton=Automaton(acc, label_on='entry'",
    "SparseMDP": "row_start=[0, 2, 3, 4], rewards={steps: Rewards(state=[1, 0, 0]",
    "Rewards": "Rewards(state=[1, 0, 0], choice=None, transition=None)",
    "Solution": "value=[1, 0, 1], residual=0, num_steps=0, status=CONVERGED, method='the graph'",
    "Game": "mdp=MDP(successor=int32[32, 5, 1], system=bool[32] with 16 of 32 true",
    "Verification": "Verification(system=False, environment=True, reason='state 3 loses')",
    "Estimate": "mean=0.5, lower=0.25, upper=0.75, method='exact'",
    "Evaluation": "success=Estimate(mean=0.5, lower=0.25, upper=0.75, status=MAX_STEPS",
    "Environment": "reset=partial(partial(_start)), observe=partial(partial(_see)), actions=Finite(num=3)",
    "Answer": "value=[0.5], status=PRECISION, method='levels'",
    "Property": "Property(text='P>=0.5 [ F \"a\" ]')",
    "TaskWorld": "memory=1, verdict=VIOLATED, accepted=True, visits=3",
}


@pytest.mark.parametrize("name", TEXTS)
def test_fields_are_told(name):
    text, place = told(made()[name]), 0
    for part in re.split(r", (?=\w+=)", TEXTS[name]):
        assert part in text[place:], f"{part!r} in {text}"
        place = text.index(part, place)


def test_all_are_short():
    for name, value in made().items():
        assert told(value).startswith(f"{name}(")


# --- every type ---------------------------------------------------------------------------------


@cache
def brief_classes():
    """Each class with a text of its own: public, of a learner, or of a world."""
    _ = jl.__all__
    for package in (algos, envs):
        for module in pkgutil.iter_modules(package.__path__, f"{package.__name__}."):
            importlib.import_module(module.name)
    return {
        f"{found.__module__}.{found.__qualname__}": found
        for name, module in list(sys.modules.items())
        if name.startswith("jaxltl.")
        for found in vars(module).values()
        if isinstance(found, type) and "_brief" in vars(found)
    }


def test_every_public_type_shows_itself():
    spaces = (jl, *(getattr(jl, name) for name in core.__all__))
    public = {getattr(space, name) for space in spaces for name in space.__all__}
    public = {
        x for x in public if not (typing.is_typeddict(x) or getattr(x, "_is_protocol", False))
    }
    others = {jl.logic.Formula, jl.Status, jl.environments.Verdict, jl.NotConverged}
    others |= {jl.models.Controller}
    plain = {x for x in public if isinstance(x, type)} - others - {*brief_classes().values()}
    assert not plain
    for module in algos.__all__:
        for name in ("Problem", "Hparams", "State", "Metrics"):
            found = getattr(getattr(algos, module), name, None)
            is_ours = str(getattr(found, "__module__", "")).startswith("jaxltl.")
            is_ours &= not getattr(found, "_is_protocol", False)
            assert not is_ours or found in brief_classes().values(), f"{module}.{name}"


HUGE = np.broadcast_to(np.float32(0.5), (10**6, 10**6))
STRANGE = {
    "too large to be read": HUGE,
    "abstract": jax.ShapeDtypeStruct((4, 3, 2), np.float32),
    "none": None,
    "a text": "word " * 1000,
    "an object": object(),
    "a tree": {"a": [np.ones(3)]},
    "many lines": SimpleNamespace(text="\n" * 50),
}


@pytest.mark.parametrize("kind", STRANGE)
def test_nothing_is_too_large_or_strange(kind):
    for cls in brief_classes().values():
        if hasattr(cls, "_make"):
            value = cls._make([STRANGE[kind]] * len(cls._fields))
        else:
            value = object.__new__(cls)
            for one in dataclasses.fields(cls):
                static = not one.metadata.get("pytree_node", True)
                object.__setattr__(value, one.name, ("a",) if static else STRANGE[kind])
        assert told(value).startswith(f"{cls.__name__}(")


def test_formulas_are_cut_off():
    assert len(repr(jl.parse_ltl(" & ".join(f"F a{i}" for i in range(500))))) < 1000


# --- inside of programs, side by side, elsewhere -------------------------------------------------


def trees():
    return [
        x
        for x in made().values()
        if not jax.tree.all(jax.tree.map(lambda _: False, x))
        and all(isinstance(leaf, np.ndarray | jax.Array) for leaf in jax.tree.leaves(x))
    ]


def test_traced_ones_are_told_by_their_shapes():
    texts = []
    assert len(trees()) > 15

    def look(values):
        texts.extend(map(told, values))
        return values

    shapes = jax.eval_shape(look, trees())
    texts += map(told, shapes)
    lanes = jax.tree.map(lambda x: np.stack([np.asarray(x)] * 2), trees())
    jax.vmap(lambda values: texts.extend(map(told, values)))(lanes)
    texts += map(told, lanes)
    assert any("successor=int32[20, 4, 3], " in text for text in texts)


def test_statuses_are_counted():
    one = made()["Solution"]
    four = jax.tree.map(lambda x: np.stack([np.asarray(x)] * 4), one)
    assert "status=3 CONVERGED, 1 MAX_STEPS" in told(four.replace(status=np.array([0, 4, 0, 0])))


def test_arrays_on_several_devices_are_read_from_here():
    mesh = jax.make_mesh((4,), ("x",))
    spread = jax.device_put(np.arange(8.0), NamedSharding(mesh, PartitionSpec("x")))
    assert show.describe(spread) == "float64[8] from 0 to 7"
    spread.delete()
    assert show.describe(spread) == "float64[8]"


def test_nothing_is_moved_where_that_is_forbidden():
    value = jnp.arange(9.0)
    with jax.transfer_guard_device_to_host("disallow"):
        assert show.describe(value).startswith("float64[9]")


def test_they_are_the_same_in_another_process_and_after_a_walk_over_the_tree():
    for value in trees():
        text = repr(value)
        assert repr(pickle.loads(pickle.dumps(value))) == text
        assert repr(jax.tree.map(lambda x: x, value)) == text


# --- learners ------------------------------------------------------------------------------------


def test_settings_are_told_as_they_are():
    assert repr(behavioral_cloning.Hparams()) == (
        "Hparams(learning_rate=0.003, l2=0.0, patience=500, batch=128)"
    )
    many = mlirl.Hparams(discount=np.linspace(0, 0.9, 20))
    assert "discount=float64[20] from 0 to 0.9, mu=None" in told(many)
    changing = cce.Hparams(rate=Linear(1.0, 0.1, 100))
    assert "rate=Linear(" in told(changing)
    assert "num_envs=8" in told(ppo.Hparams(discount=0.99))


def test_states_and_metrics_are_told_with_their_arrays():
    state = mlirl.State(jax.random.key(0), np.int32(20), {"w": np.ones(8)}, np.ones((20, 3)), ())
    assert told(state) == (
        "State( key=key<fry>[], step=20, parameters={w: float64[8] all 1}, "
        "value=float64[20, 3] all 1, optimizer=())"
    )
    rows = behavioral_cloning.Metrics(
        loss=np.linspace(3, 1, 9),
        held_out=np.append(np.ones(8), np.nan),
        gradient_norm=np.ones(3),
        status=np.array([0, 0, 5]),
    )
    assert told(rows) == (
        "Metrics( loss=float64[9] from 1 to 3, held_out=float64[9] all 1, 1 nan, "
        "gradient_norm=[1, 1, 1], status=2 CONVERGED, 1 NONFINITE)"
    )


# --- pictures ------------------------------------------------------------------------------------

DRAWN = (
    "MDP",
    "DenseMDP",
    "Automaton",
    "Product",
    "SparseMDP",
    "Solution",
    "Game",
    "Winning",
    "Permissive",
)


@pytest.mark.parametrize("name", DRAWN)
def test_pictures_have_their_texts(name):
    value, before = made()[name], dict(matplotlib.rcParams)
    loaded = "matplotlib.pyplot" in sys.modules
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        picture, page = value._repr_svg_(), value._repr_html_()
    assert dict(matplotlib.rcParams) == before
    assert ("matplotlib.pyplot" in sys.modules) == loaded
    root = ElementTree.fromstring(picture)
    text = " ".join(repr(value).split())
    assert root.get("role") == "img" and root.get("aria-label") == text
    assert root[0].tag.endswith("title") and root[0].text == text
    assert len(ElementTree.fromstring(page)) == 2
    assert "".join(ElementTree.fromstring(page)[1].itertext()) == repr(value)


def test_what_would_crowd_is_not_drawn():
    crowd = jl.make_sparse(None, np.arange(101), np.zeros(100, int), np.ones(100))
    assert crowd._repr_svg_() is None and crowd._repr_html_() is None
    lanes = jax.tree.map(lambda x: np.stack([np.asarray(x)] * 2), made()["Automaton"])
    assert lanes._repr_svg_() is None
    assert made()["Solution"].replace(value=HUGE)._repr_html_() is None
    for value in jax.eval_shape(lambda x: x, [made()["MDP"], made()["Product"]]):
        assert value._repr_html_() is None


def test_a_failing_picture_is_left_out(monkeypatch):
    def fail(*arguments, **options):
        raise RuntimeError("no room")

    monkeypatch.setattr("jaxltl.plot.notebook.to_bytes", fail)
    assert all(made()[name]._repr_html_() is None for name in DRAWN)


def test_texts_of_pages_are_escaped():
    name = jl.to_automaton('F "<b> & \\"c"')
    page = ElementTree.fromstring(name._repr_html_())
    assert "".join(page[1].itertext()) == repr(name)


def test_layouts_are_cut_off():
    long = show.brief(dataclasses.make_dataclass("Long", [f"field_{i}" for i in range(40)]))
    text = repr(long(*["word " * 20] * 40))
    assert text.count("\n") == show.LINES - 1 and text.endswith("...)")
