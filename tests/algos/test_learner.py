"""Laws that every learner keeps: one suite, parametrised over learners.

What takes time is compiling, so each learner is compiled once alone and once as a batch, with runs
of as many rows: their number of steps is an argument.
"""

from __future__ import annotations

import importlib
import inspect
import pickle
from dataclasses import replace
from functools import cache, partial
from pathlib import Path
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.tree_util import Partial

import jaxltl as jl
from jaxltl import algos
from jaxltl.algos import mlirl, training
from jaxltl.algos.common import checkpoint, learner, loops
from jaxltl.algos.common.chunks import ChunkOptions, run_in_chunks
from jaxltl.core import struct
from jaxltl.core.models.mdp import MDP
from jaxltl.core.types import Status
from tests.algos.cases import LEARNERS, LearnerCase
from tests.support import counted_traces, lane

MAX_PROGRAMS = 450  # that the default tests compile at most


@struct.dataclass
class ToyState:
    key: jax.Array
    step: jax.Array
    position: jax.Array


@struct.dataclass
class ToyMetrics:
    at: jax.Array
    x: jax.Array
    status: jax.Array


def toy_init(key, problem, hparams):
    return ToyState(key, jnp.int32(0), problem + jax.random.normal(key, problem.shape))


def toy_step(state, problem, hparams):
    """A noisy descent, which uses its key as learners do."""
    noise = jax.random.normal(learner.step_key(state), problem.shape)
    position = state.position - hparams * (state.position - problem + noise)
    metrics = ToyMetrics(state.step, position.sum(), jnp.int32(0))
    return ToyState(state.key, state.step + 1, position), metrics


TOY = SimpleNamespace(
    policy=lambda state, problem, hparams: state.position,
    **learner.bind(toy_init, toy_step)._asdict(),
)


def cases_of(name):
    """The cases in the tests of a learner."""
    return importlib.import_module(f"tests.algos.test_{name.rpartition('.')[2]}").CASES


CASES = {"toy": lambda: LearnerCase(TOY, jnp.arange(3.0), 0.1, 0.2)}
for learner_name in LEARNERS:
    CASES |= cases_of(learner_name)

# Two ways to write a problem of one learner down, and a network that remembers, which takes
# longest to compile, have the laws of the others; the last is tested beside its learner, too.
MORE = ("mlirl-world", "ppo-memory")
SLOW = ("trpo", "q-generalized")  # the default tests have another method of each learner


def each(names):
    marks = dict.fromkeys(MORE, pytest.mark.exhaustive) | dict.fromkeys(SLOW, pytest.mark.slow)
    return pytest.mark.parametrize("name", [pytest.param(x, marks=marks.get(x, ())) for x in names])


by_learner = each(CASES)


@cache
def case(name: str) -> LearnerCase:
    return CASES[name]()


@cache
def starts(name: str):
    """Three runs side by side; the first and the last have the same key."""
    module, problem, hparams, *_ = case(name)
    keys = jax.random.split(jax.random.key(0), 3)
    init = jax.jit(jax.vmap(module.init, (0, None, None)))
    return init(keys.at[2].set(keys[0]), problem, hparams)


def start(name: str, i: int = 0):
    return lane(starts(name), i)


def steps(name: str, state, num_steps, problem=None, hparams=None):
    """A run in two rows, whatever its length: one program serves all."""
    module, own, asked, *_ = case(name)
    return module.run(
        state,
        own if problem is None else problem,
        asked if hparams is None else hparams,
        num_steps=num_steps,
        max_rows=2,
    )


@cache
def four_steps(name: str):
    return steps(name, start(name), 4)


@cache
def lanes(name: str):
    """Four steps of all three."""
    return jax.jit(jax.vmap(partial(steps, name, num_steps=4)))(starts(name))


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


def differ(one, other):
    return sum((x != y).any() for x, y in zip(leaves(one), leaves(other), strict=True))


@by_learner
def test_a_run_split_in_two_is_the_run(name):
    state, first = steps(name, start(name), 2)
    state, second = steps(name, state, 2)
    whole, metrics = four_steps(name)
    assert_bitwise(state, whole)
    ends = jax.tree.map(lambda x, y: np.stack([x[1], y[1]]), first, second)
    assert_bitwise(ends, jax.tree.map(np.asarray, metrics))
    assert state.step == 4


@by_learner
def test_a_lane_is_as_if_alone(name):
    """Up to rounding: a batch is compiled to other instructions, so the bits may differ."""
    alone = four_steps(name)
    for x, y in zip(leaves(lanes(name)), leaves(alone), strict=True):
        np.testing.assert_allclose(x[0], y, rtol=1e-8, atol=1e-8)


@by_learner
def test_the_key_decides(name):
    states, metrics = lanes(name)
    assert_bitwise(lane(states, 0), lane(states, 2))
    assert_bitwise(lane(metrics, 0), lane(metrics, 2))
    assert differ(lane(states, 0), lane(states, 1)) >= 2, "more than the key itself"


@by_learner
def test_new_numbers_do_not_retrace(name):
    four_steps(name)
    with counted_traces() as traced:
        state, _ = steps(name, start(name), 6, hparams=case(name).other)
    assert not traced
    assert state.step == 6
    short, _ = steps(name, start(name), 4, hparams=case(name).other)
    assert differ(short, four_steps(name)[0])


def nudged(tree, dtype=float):
    """The same shapes, and one number a little different."""
    flat, structure = jax.tree.flatten(tree)
    i = next(
        i
        for i, x in enumerate(flat)
        if np.size(x)
        and np.issubdtype(getattr(x, "dtype", type(x)), np.floating)
        and np.isfinite(np.ravel(x)[0])
    )
    changed = np.array(flat[i], float)
    changed.flat[0] = changed.flat[0] * 0.75 + 0.125
    flat[i] = jnp.asarray(changed, getattr(flat[i], "dtype", None))
    return jax.tree.unflatten(structure, flat)


@by_learner
def test_a_saved_state_goes_on_bitwise_and_with_nothing_else(name, tmp_path):
    _, problem, hparams, other, _ = case(name)
    given = checkpoint.fingerprint(problem=problem, hparams=hparams)
    state, _ = steps(name, start(name), 2)
    checkpoint.save(tmp_path / "state.npz", state, given)
    loaded = checkpoint.load(tmp_path / "state.npz", start(name, 1), given)
    assert_bitwise(loaded, state)
    state, _ = steps(name, loaded, 2)
    assert_bitwise(state, four_steps(name)[0])
    for changed in ({"problem": nudged(problem)}, {"hparams": other}):
        now = checkpoint.fingerprint(**{"problem": problem, "hparams": hparams, **changed})
        with pytest.raises(ValueError, match=f"not belong to this run: {next(iter(changed))}"):
            checkpoint.load(tmp_path / "state.npz", start(name), now)


def test_every_learner_is_exported_and_keeps_the_laws():
    """A module of `algos` that binds the loops of learners is in ``algos.__all__`` and has a case."""
    folder = Path(algos.__file__).parent
    bound = {
        str(path.relative_to(folder).with_suffix("")).replace("/", ".").removesuffix(".learner")
        for path in folder.rglob("*.py")
        if "= learner.bind(" in path.read_text() and path.parent.name != "common"
    }
    assert bound == set(LEARNERS)
    assert {x.partition(".")[0] for x in bound} <= set(algos.__all__)
    assert {case(name).module for name in CASES if name != "toy"} == set(LEARNERS.values())


@by_learner
def test_every_learner_is_called_alike(name):
    module, problem, hparams, *_ = case(name)
    for function, arguments in {
        "init": ["key", "problem", "hparams"],
        "step": ["state", "problem", "hparams"],
        "policy": ["state", "problem", "hparams"],
    }.items():
        assert list(inspect.signature(getattr(module, function)).parameters) == arguments
    if name != "toy":
        for kind in ("Problem", "Hparams", "State", "Metrics"):
            assert inspect.isclass(getattr(module, kind))
        assert isinstance(hparams, module.Hparams) and isinstance(problem, module.Problem)
    whole = {"num_steps": inspect.Parameter.empty, "max_rows": 1000}
    early = {
        "until": inspect.Parameter.empty,
        "num_steps": inspect.Parameter.empty,
        "check_every": 1,
        "keep": "before" if module is mlirl else "after",
    }
    for function, first, options, returned in (
        (module.run, "state", whole, "``Metrics``"),
        (module.train, "key", whole, "``Metrics``"),
        (module.run_until, "state", early, "Learned"),
        (module.train_until, "key", early, "Learned"),
    ):
        given = inspect.signature(function).parameters.values()
        assert [x.name for x in given if x.kind == x.POSITIONAL_OR_KEYWORD] == [
            first,
            "problem",
            "hparams",
        ]
        assert {x.name: x.default for x in given if x.kind == x.KEYWORD_ONLY} == options
        assert f"  {first}: " in function.__doc__
        assert returned in inspect.getdoc(function).split("Returns:")[1]
        if name != "toy":
            assert function is getattr(module, function.__name__)
            assert pickle.loads(pickle.dumps(function)) is function
    state, metrics = four_steps(name)
    assert_bitwise(state.key, start(name).key)
    assert metrics.status.shape == (2,), "as many rows as were asked for, after any steps"
    assert set(np.asarray(metrics.status).tolist()) <= set(Status)


@pytest.mark.few(2)
@each(["q-maximin", "cce", "rmax", "mlirl-product", "ppo"])
def test_a_traced_hyperparameter_out_of_range_is_invalid(name):
    module, problem, hparams, *_ = case(name)
    field = "temperature" if name == "cce" else "discount"

    @jax.jit
    def trained(value):
        changed = hparams.replace(**{field: value})
        _, metrics = module.train(jax.random.key(0), problem, changed, num_steps=2, max_rows=2)
        return metrics.status

    assert (trained(-0.5) >= Status.INVALID).all() and (trained(jnp.nan) >= Status.INVALID).all()
    assert (trained(getattr(hparams, field)) < Status.INVALID).all()


# --- what does not exist does not matter ------------------------------------------------------


def disturbed(tree):
    """The same problem with other numbers wherever there is no action or no successor."""

    def model(x):
        if not isinstance(x, MDP):
            return x
        exists, used = np.asarray(x.available), np.asarray(x.probability) > 0
        last = np.asarray(x.successor).max()
        return x.replace(
            successor=jnp.asarray(np.where(used, x.successor, last), jnp.int32),
            probability=jnp.asarray(np.where(exists[..., None], x.probability, 0.7)),
        )

    return jax.tree.map(model, tree, is_leaf=lambda x: isinstance(x, MDP))


@by_learner
def test_what_is_not_available_changes_nothing(name):
    """Bit for bit: what was learned, and all figures."""
    module, problem, hparams, _, reward = case(name)
    other = disturbed(problem)
    if reward is not None:
        model = problem.model if hasattr(problem, "model") else problem.game
        values = np.array(getattr(problem, reward))
        values[~np.asarray(model.available)] = -1e9
        other = other.replace(**{reward: jnp.asarray(values)})
    if not differ(other, problem):
        pytest.skip("the problem has no actions that are not available, and no padding")
    assert_bitwise(steps(name, start(name), 4, problem=other)[1], four_steps(name)[1])
    state, policy = four_steps(name)[0], jax.jit(module.policy)
    found = steps(name, start(name), 4, problem=other)[0]
    assert_bitwise(policy(found, other, hparams), policy(state, problem, hparams))


# --- what the shared loop does, shown on the cheapest learner ----------------------------------


@pytest.mark.parametrize(
    ("num_steps", "max_rows"), [(1, 1), (6, 6), (10, 4), (7, 3), (9, 1), (12, 5)]
)
def test_metrics_are_thinned_and_end_with_the_last_step(num_steps, max_rows):
    module, problem, hparams, *_ = case("toy")
    state, metrics = module.run(
        start("toy"), problem, hparams, num_steps=num_steps, max_rows=max_rows
    )
    rows = metrics.at.tolist()
    assert len(rows) <= max_rows
    assert rows[-1] == num_steps - 1
    assert len(set(np.diff(rows).tolist())) <= 1, "evenly spaced"
    every, all_metrics = module.run(start("toy"), problem, hparams, num_steps=num_steps)
    assert_bitwise(state, every)
    np.testing.assert_array_equal(metrics.x, np.asarray(all_metrics.x)[rows])


@pytest.mark.parametrize("limits", [{"num_steps": 0}, {"num_steps": 5, "max_rows": 0}])
def test_runs_have_at_least_one_step_and_row(limits):
    module, problem, hparams, *_ = case("toy")
    with pytest.raises(ValueError, match="must be at least 1"):
        module.run(start("toy"), problem, hparams, **limits)


def test_counters_stay_where_they_end():
    most = np.iinfo(np.int32).max
    total = jnp.asarray(np.array([0, most - 3, most - 2, most], np.int32))
    assert learner.saturating_add(total, 3).tolist() == [3, most, most, most]


def reaches(number, before, after, metrics):
    return metrics.at >= number


def test_a_run_ends_with_the_step_that_meets_the_condition():
    module, problem, hparams, *_ = case("toy")
    run = partial(module.run_until, start("toy"), problem, hparams)
    found = jl.check(run(until=Partial(reaches, 5), num_steps=20))
    whole, metrics = module.run(start("toy"), problem, hparams, num_steps=6, max_rows=1)
    # Another program, which the compiler may round in another way.
    for x, y in zip(
        leaves((found.state, found.metrics.x)), leaves((whole, metrics.x[0])), strict=True
    ):
        np.testing.assert_allclose(x, y, rtol=1e-12)
    assert (found.num_steps, found.metrics.at) == (6, 5)
    with counted_traces() as traced:
        late = run(until=Partial(reaches, 50), num_steps=9)
    assert not traced, "numbers are arguments"
    assert (late.status, late.num_steps, late.state.step) == (Status.MAX_STEPS, 9, 9)
    kept = run(until=Partial(reaches, 5), num_steps=20, keep="before")
    assert (kept.num_steps, kept.state.step, kept.metrics.at) == (6, 5, 5)
    windows = run(until=lambda before, after, _: after.step >= 4, num_steps=20, check_every=3)
    assert windows.num_steps == 6
    seen = run(
        until=lambda before, after, _: after.step - before.step == 3, num_steps=20, check_every=3
    )
    assert seen.num_steps == 3


def test_lanes_end_each_for_itself():
    module, problem, hparams, *_ = case("toy")
    most = jnp.array([3, 50, 7])
    found = jax.vmap(
        lambda state, n: module.run_until(
            state, problem, hparams, until=Partial(reaches, n), num_steps=20
        )
    )(starts("toy"), most)
    assert found.num_steps.tolist() == [4, 20, 8]
    assert found.status.tolist() == [Status.COMPLETED, Status.MAX_STEPS, Status.COMPLETED]
    for i, number in enumerate([4, 20, 8]):
        alone, _ = module.run(start("toy", i), problem, hparams, num_steps=number, max_rows=1)
        np.testing.assert_allclose(found.state.position[i], alone.position, rtol=1e-12)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"keep": "both"}, "keep='both'; choose"),
        ({"check_every": 0}, "check_every=0; it must be at least 1"),
        ({"num_steps": 0}, "num_steps=0; it must be at least 1"),
        ({"idle": True, "keep": "before"}, "idle=True requires"),
    ],
)
def test_runs_that_make_no_sense_are_refused(options, message):
    module, problem, hparams, *_ = case("toy")
    given = (problem, hparams, Partial(reaches, 1), options.get("num_steps", 3))
    options = {k: x for k, x in options.items() if k != "num_steps"}
    with pytest.raises(ValueError, match=message):
        loops.run_until(module.step, start("toy"), given, **options)


def test_a_loop_of_lanes_is_a_while_loop():
    """Lanes of different lengths; what is given shared or not; nested."""

    def active(carry, given):
        return carry["n"] < given["most"]

    def body(carry, given):
        go = active(carry, given)
        return {"n": carry["n"] + go, "sum": carry["sum"].at[0].add(go * given["step"])}

    def loop(n, most, step):
        carry = {"n": n, "sum": jnp.zeros(2)}
        return loops.while_active(active, body, carry, {"most": most, "step": step})

    most = jnp.array([[3, 0, 7], [1, 5, 2]])
    step = jnp.array([1.0, 10.0])
    alone = loop(jnp.int32(1), most[0, 2], step[1])
    assert alone["n"] == 7 and alone["sum"].tolist() == [60.0, 0.0]
    inner = jax.vmap(loop, (None, 0, None))
    found = jax.jit(jax.vmap(inner, (None, 0, 0)))(jnp.int32(1), most, step)
    np.testing.assert_array_equal(found["n"], np.maximum(most, 1))
    np.testing.assert_array_equal(
        found["sum"][..., 0], (np.maximum(most, 1) - 1) * np.array([[1], [10]])
    )
    assert (found["sum"][..., 1] == 0).all()


# --- in chunks --------------------------------------------------------------------------------


def test_a_run_in_chunks_is_the_run():
    module, problem, hparams, *_ = case("toy")
    reports = []
    found = run_in_chunks(
        module.step,
        start("toy"),
        problem,
        hparams,
        num_steps=10,
        options=ChunkOptions(chunk=4, report=lambda done, row: reports.append((done, int(row.at)))),
    )
    whole, metrics = module.run(start("toy"), problem, hparams, num_steps=10)
    assert_bitwise(found.state, whole)
    np.testing.assert_array_equal(found.metrics.x, metrics.x)
    assert found.step.tolist() == list(range(1, 11)) and not found.done
    assert reports == [(4, 3), (8, 7), (10, 9)]
    long = run_in_chunks(module.step, start("toy"), problem, hparams, num_steps=3000)
    assert len(long.step) == 1000, "rows do not grow with steps"


def test_runs_side_by_side_in_chunks():
    """Each with its own number and its own end."""
    module, problem, *_ = case("toy")
    given = np.array([0.1, 0.2, 0.3])
    chunks = partial(run_in_chunks, module.step, problem=problem, num_steps=9)
    options = ChunkOptions(
        chunk=4,
        lanes=True,
        until=lambda before, after, metrics: metrics.at >= 20 * given[0] + 3 * (after.step == 4),
    )
    found = chunks(starts("toy"), hparams=given, options=options)
    assert found.step.tolist() == [1, 2, 3, 4] and found.done.all()
    assert found.state.step.tolist() == [3, 3, 3]
    for i in range(3):
        alone, metrics = module.run(start("toy", i), problem, given[i], num_steps=3)
        np.testing.assert_allclose(found.state.position[i], alone.position, rtol=1e-12)
        np.testing.assert_allclose(found.metrics.x[:3, i], metrics.x, rtol=1e-12)
    assert_bitwise(found.metrics.x[2], found.metrics.x[3])
    one = chunks(
        jax.tree.map(lambda x: x[None], start("toy")),
        hparams=0.1,
        options=replace(options, keep="before", until=Partial(reaches, 2)),
    )
    assert one.done.tolist() == [True] and one.state.step.tolist() == [2]


@pytest.mark.parametrize("name", ["toy", "cloning"])
def test_an_interrupted_run_resumes_and_ends_bitwise_equal(name, tmp_path):
    module, problem, hparams, other, _ = case(name)
    path = tmp_path / "run.npz"
    seen = []

    def interrupt(done, metrics):
        seen.append(done)
        raise KeyboardInterrupt

    def run(state, hparams, problem=problem, **options):
        return run_in_chunks(
            module.step,
            state,
            problem,
            hparams,
            num_steps=6,
            options=ChunkOptions(chunk=3, **options),
        )

    with pytest.raises(KeyboardInterrupt):
        run(state=start(name), hparams=hparams, report=interrupt, checkpoint=path)
    found = run(
        state=start(name),
        hparams=hparams,
        checkpoint=path,
        report=lambda done, _: seen.append(done),
    )
    whole = run(state=start(name), hparams=hparams)
    assert seen == [3, 6]
    assert_bitwise(found, whole)
    again = run(state=start(name), hparams=hparams, checkpoint=path)
    assert_bitwise(again, whole)
    for changed in ({"hparams": other}, {"hparams": hparams, "problem": nudged(problem)}):
        with pytest.raises(ValueError, match="does not belong to this run"):
            run(state=start(name), checkpoint=path, **changed)


# --- from the host: callbacks, saved runs and sweeps --------------------------------------------


@by_learner
def test_a_run_with_a_callback_that_was_interrupted_is_the_run(name, tmp_path):
    module, problem, hparams, *_ = case(name)
    own, metrics = four_steps(name)  # metrics of the steps 2 and 4
    run = partial(training.train, module, start(name), problem, hparams)
    run = partial(run, num_steps=4, max_rows=4, every=2, checkpoint=tmp_path / "run.npz")
    half, rows = run(callback=lambda *_: next(iter(())))  # StopIteration
    assert half.step.item() == 2 == len(jax.tree.leaves(rows)[0])
    seen = []
    state, rows = run(callback=lambda state, newest: seen.append((state, newest)))
    assert_bitwise(state, own)
    assert_bitwise(jax.tree.map(lambda x: x[1::2], rows), metrics)
    assert_bitwise(seen, [(own, lane(rows, 3))])
    assert_bitwise(run(callback=lambda *_: 1 / 0), (own, rows))  # finished: only read


@pytest.mark.parametrize(
    "name", [x if x in ("toy", "sarsa") else pytest.param(x, marks=pytest.mark.slow) for x in CASES]
)
def test_a_run_of_a_sweep_is_the_run_by_itself(name):
    module, problem, hparams, *_ = case(name)
    keys = jax.random.split(jax.random.key(3), 2)
    runs = training.sweep(module, keys, problem, hparams, num_steps=4, max_rows=2)
    state, metrics = steps(name, module.init(keys[1], problem, hparams), 4)
    assert_bitwise(runs.states[0][1], state)
    assert_bitwise(jax.tree.map(lambda x: x[0, 1], runs.metrics), metrics)
    assert runs.step.tolist() == [2, 4]
