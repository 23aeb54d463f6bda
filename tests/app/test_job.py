"""Seeds of a job over the devices of a mesh: the runs that they are on one, saved and gone on from."""

from functools import partial

import jax
import numpy as np
import pytest

from jaxltl.app.job import run_seeds
from tests.algos.test_learner import case


def mesh_of(count):
    return jax.make_mesh((count,), ("devices",), devices=jax.devices()[:count])


def same(one, other):
    for x, y in zip(jax.tree.leaves(one), jax.tree.leaves(other), strict=True):
        if jax.dtypes.issubdtype(x.dtype, jax.dtypes.prng_key):
            x, y = jax.random.key_data(x), jax.random.key_data(y)
        np.testing.assert_array_equal(np.asarray(x), np.asarray(y))


@pytest.fixture(scope="module")
def seeds():
    module, problem, hparams, _ = case("toy")
    return partial(run_seeds, module, (3, 3), problem, hparams, None, num_steps=6, chunk=2)


@pytest.mark.slow
def test_seeds_over_devices_are_the_seeds(seeds, tmp_path):
    """Also where they cannot be split evenly, and where a run goes on on other devices."""
    found, history = seeds()
    for count in (2, 3):
        path = tmp_path / f"{count}.npz"
        there, told = seeds(mesh=mesh_of(count), checkpoint=path)
        same(there, found)
        same(told, history)
        # What was saved after the last step is what all ended with.
        for elsewhere in (None, mesh_of(4)):
            again, _ = seeds(mesh=elsewhere, checkpoint=path)
            same(again, found)


def test_a_seed_alone_uses_one_device(seeds):
    module, problem, hparams, _ = case("toy")
    alone = partial(run_seeds, module, (3, 1), problem, hparams, None, num_steps=2)
    same(alone(mesh=mesh_of(2))[0], alone()[0])


@pytest.mark.slow
def test_a_run_goes_on_on_other_devices(seeds, tmp_path):
    module, problem, hparams, _ = case("toy")

    def leave(step, figures):
        if step == 4:
            raise KeyboardInterrupt

    path = tmp_path / "run.npz"
    with pytest.raises(KeyboardInterrupt):
        run_seeds(
            module,
            (3, 3),
            problem,
            hparams,
            leave,
            num_steps=6,
            chunk=2,
            checkpoint=path,
            mesh=mesh_of(3),
        )
    made = []
    found, _ = run_seeds(
        module,
        (3, 3),
        problem,
        hparams,
        lambda step, _: made.append(step),
        num_steps=6,
        chunk=2,
        checkpoint=path,
        mesh=mesh_of(2),
    )
    assert made == [6]
    same(found, seeds()[0])
