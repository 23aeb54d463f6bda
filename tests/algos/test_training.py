"""Runs from the host: callbacks, saved runs, sweeps, and their tables; on a learner without a model.

That the results are those of the learner's own run, bit for bit, is a law of ``test_learner.py``.
"""

from functools import partial
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxltl as jl
from jaxltl import plot
from jaxltl.algos import training
from jaxltl.algos.common import learner
from jaxltl.algos.common.settings import Number, static, traced
from jaxltl.core import struct
from jaxltl.core.validation import Range


@struct.dataclass
class State:
    key: jax.Array
    step: jax.Array
    guess: jax.Array


@struct.dataclass
class Metrics:
    error: jax.Array
    status: jax.Array


@struct.dataclass
class Hparams:
    rate: Number = traced(Range(0, 1), default=0.5)
    offset: Number | None = traced(Range(0), default=None)
    size: int = static(Range(1, 9, integer=True), default=1)


def _init(key, problem, hparams):
    guess = jax.random.normal(learner.init_key(key), (hparams.size,))
    return State(key, jnp.int32(0), guess)


def _step(state, problem, hparams):
    noise = 0.01 * jax.random.normal(learner.step_key(state), state.guess.shape)
    guess = state.guess + hparams.rate * (problem - state.guess) + noise
    metrics = Metrics(jnp.abs(guess - problem).max(), jnp.int32(jl.Status.COMPLETED))
    return State(state.key, state.step + 1, guess), metrics


FIT = SimpleNamespace(**learner.bind(_init, _step)._asdict())
KEY = jax.random.key(0)
train = partial(training.train, FIT, KEY, 3.0, Hparams())
sweep = partial(training.sweep, FIT, jax.random.split(KEY, 3), 3.0, Hparams(), num_steps=4)


def test_the_callback_is_called_after_each_chunk_with_state_and_newest_metrics():
    seen = []
    state, metrics = train(
        num_steps=10, every=4, callback=lambda state, newest: seen.append((state, newest))
    )
    assert [int(x.step) for x, _ in seen] == [4, 8, 10]
    assert [x.error for _, x in seen] == [metrics.error[i] for i in (3, 7, 9)]
    assert all(type(x.error) is np.float64 for _, x in seen)
    assert isinstance(metrics.error, np.ndarray) and metrics.error.shape == (10,)
    assert np.array_equal(seen[-1][0].guess, state.guess)
    few = []
    _, rows = train(num_steps=1000, max_rows=10, every=150, callback=lambda s, _: few.append(s))
    assert len(rows.error) == 10 and [int(x.step) for x in few] == [200, 400, 600, 800, 1000]


def test_a_run_that_ended_early_continues_from_its_state():
    def stop(state, newest):
        raise StopIteration

    half, rows = train(num_steps=10, every=4, callback=stop)
    assert half.step == 4 == len(rows.error)
    rest, _ = training.train(FIT, half, 3.0, Hparams(), num_steps=10)
    whole, _ = FIT.train(KEY, 3.0, Hparams(), num_steps=10)
    assert np.array_equal(rest.guess, whole.guess) and rest.step == 10


def test_an_interrupt_leaves_a_checkpoint_that_continues(tmp_path):
    run = partial(train, num_steps=10, every=4, checkpoint=tmp_path / "run.npz")

    def interrupt(state, newest):
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        run(callback=interrupt)
    seen = []
    state, rows = run(callback=lambda state, _: seen.append(int(state.step)))
    whole, metrics = FIT.train(KEY, 3.0, Hparams(), num_steps=10)
    assert seen == [8, 10] and np.array_equal(rows.error, metrics.error)
    assert np.array_equal(state.guess, whole.guess)
    longer, rows = run(num_steps=12)
    assert longer.step == 12 == len(rows.error)
    for name, changed in {
        "rate": {"hparams": Hparams(rate=0.1)},
        "problem": {"problem": 2.0},
        "key": {"start": jax.random.key(1)},
    }.items():
        arguments = {"start": KEY, "problem": 3.0, "hparams": Hparams(), **changed}
        with pytest.raises(ValueError, match=f"does not belong to this run: .*{name}"):
            training.train(FIT, **arguments, num_steps=20, checkpoint=tmp_path / "run.npz")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"num_steps": 0}, "num_steps=0"),
        ({"every": 0}, "every=0"),
        ({"callback": 3}, "callback is 3"),
        ({"learner": 3}, "learner is 3, without init and step"),
        ({"start": FIT.init(KEY, 3.0, Hparams()).replace(step=jnp.int32(4))}, "made 4 steps"),
        ({"start": jax.random.split(KEY)}, "key is"),
        ({"hparams": Hparams(rate=2.0)}, "rate=2"),
    ],
)
def test_what_train_refuses(change, message):
    arguments = {"learner": FIT, "start": KEY, "problem": 3.0, "hparams": Hparams()}
    with pytest.raises(ValueError, match=message):
        training.train(**{**arguments, "num_steps": 4, **change})


def test_inside_jit_the_learners_own_train_is_named():
    with pytest.raises(ValueError, match=r"start is traced; .* the learner's own train"):
        jax.eval_shape(lambda key: training.train(FIT, key, 3.0, Hparams(), num_steps=4), KEY)
    with pytest.raises(ValueError, match="keys is traced"):
        jax.eval_shape(
            lambda keys: training.sweep(FIT, keys, 3.0, Hparams(), num_steps=4).states,
            jax.random.split(KEY),
        )


def test_a_sweep_has_all_combinations_and_static_values():
    told = []
    runs = sweep(
        over={"rate": np.array([0.25, 0.5]), "size": [1, 2]},
        callback=lambda setting, seed, metrics: told.append((setting["size"], seed)),
    )
    assert [(x["rate"], x["size"]) for x in runs.settings] == [
        (0.25, 1), (0.25, 2), (0.5, 1), (0.5, 2)
    ]  # fmt: skip
    assert sorted(told) == sorted([(x, i) for x in (1, 2) for i in range(3)] * 2)
    assert runs.metrics.error.shape == (4, 3, 4) and runs.step.tolist() == [1, 2, 3, 4]
    state, metrics = FIT.train(jax.random.split(KEY, 3)[2], 3.0, runs.hparams[1], num_steps=4)
    assert np.array_equal(runs.states[1][2].guess, state.guess) and state.guess.shape == (2,)
    assert np.array_equal(runs.metrics.error[1, 2], metrics.error)
    assert sweep(over={"rate": [0, 0.5]}).settings == ({"rate": 0.0}, {"rate": 0.5})
    apart = sweep(over=[{"rate": 0.1}, {"offset": 1.0}, {}])
    assert apart.names == ("rate=0.1", "offset=1", "all seeds")
    assert sweep().settings == ({},)


def test_a_sweep_has_the_precision_of_its_caller():
    """Threads do not inherit it."""
    for double in (False, True):
        with jax.enable_x64(double):
            keys = jax.random.split(KEY, 2)
            runs = training.sweep(FIT, keys, 3.0, Hparams(), num_steps=4)
            _, metrics = FIT.train(keys[1], 3.0, Hparams(), num_steps=4)
        assert runs.metrics.error.dtype == metrics.error.dtype == f"float{64 if double else 32}"
        assert np.array_equal(runs.metrics.error[0, 1], metrics.error)


def test_lanes_of_an_accelerator_are_the_runs(monkeypatch):
    over = {"rate": [0.25, 0.5]}
    expected = sweep(over=over)
    monkeypatch.setattr(training, "_run_in_threads", training._run_as_lanes)
    runs = sweep(over=over)
    assert np.allclose(runs.metrics.error, expected.metrics.error, rtol=1e-12)
    assert np.allclose(runs.states[1][2].guess, expected.states[1][2].guess, rtol=1e-12)


def test_tables_have_means_and_deviations_over_seeds():
    rows = {"loss": np.array([[[9.0, 1.0, 3.0], [9.0, 4.0, np.nan]], [[1.0, 1.0, np.nan]] * 2])}
    runs = training.Sweep(({"rate": 0.1}, {"rate": 0.2}), (), (), rows, np.arange(3))
    first, second = runs.summary("loss", last=2)
    assert first == {"rate": 0.1, "seeds": 2, "loss": 3.0, "loss deviation": np.std([2, 4], ddof=1)}
    assert second["loss"] == 1.0 and second["loss deviation"] == 0.0
    lost = runs.summary("loss")[1]
    assert np.isnan(lost["loss"]) and lost["seeds"] == 2
    table = runs.table("loss", last=2).splitlines()
    assert table[:3] == [
        "| rate | seeds | loss |", "|---|---|---|", "| 0.1 | 2 | 3 ± 1.414 |"
    ]  # fmt: skip
    with pytest.raises(ValueError, match="choose one of loss"):
        runs.summary("los")


def test_a_sweep_is_drawn_with_its_own_names_and_steps():
    runs = sweep(over={"rate": [0.25, 0.5]}, max_rows=2)
    figure = plot.sweep(runs, show=["error"])
    (axes,) = figure.axes
    assert [t.get_text() for t in figure.legends[0].texts] == ["rate=0.25", "rate=0.5"]
    assert axes.get_lines()[0].get_xdata().tolist() == [2, 4]
    with pytest.raises(ValueError, match="settings is None"):
        plot.sweep({"loss": np.ones((1, 2, 3))})


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"over": {"rat": [0.1]}}, "over has 'rat'.*choose one of offset, rate, size"),
        ({"over": {"rate": 0.1}}, r"over\['rate'\] is 0.1; give a list"),
        ({"over": {"rate": []}}, r"over\['rate'\] has no values"),
        ({"over": {"rate": [0.1, 2.0]}}, "rate=2"),
        ({"over": [0.1]}, "over is float; give dicts"),
        ({"keys": KEY}, r"keys is .*jax.random.split"),
        ({"num_steps": 0}, "num_steps=0"),
        ({"callback": 1}, "callback is 1"),
        ({"hparams": SimpleNamespace(sharding=1)}, "hparams.sharding is set"),
    ],
)
def test_what_a_sweep_refuses(change, message):
    arguments = {"keys": jax.random.split(KEY, 2), "problem": 3.0, "hparams": Hparams()}
    with pytest.raises(ValueError, match=message):
        training.sweep(FIT, **{**arguments, "num_steps": 4, **change})
