"""Files of learners' states: whole or not at all, bit for bit, and for the same problem only."""

import errno
import os
import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxltl.algos import behavioral_cloning
from jaxltl.algos.common import checkpoint
from jaxltl.algos.common.chunks import ChunkOptions, run_in_chunks
from jaxltl.core.files import atomic_write
from tests.algos.test_learner import assert_bitwise, start, toy_init, toy_step


def test_nested_states_with_keys_are_saved(tmp_path):
    def state(seed):
        key = jax.random.key(seed)
        return {"a/b": (jnp.arange(3) + seed, key), "a": {"b": jnp.float32(seed)}, "c": seed > 1}

    checkpoint.save(tmp_path / "state.npz", state(3))
    assert_bitwise(checkpoint.load(tmp_path / "state.npz", state(0)), state(3))


def damaged(path, name):
    if name == "empty":
        path.write_bytes(b"")
    elif name == "text":
        path.write_text("not an archive")
    else:
        checkpoint.save(path, start("toy"))
        content = path.read_bytes()
        path.write_bytes(content[: len(content) // 2])


@pytest.mark.parametrize("name", ["empty", "text", "cut"])
def test_damaged_files_are_refused(name, tmp_path):
    path = tmp_path / "state.npz"
    damaged(path, name)
    with pytest.raises(ValueError, match=r"state\.npz' is not a saved state"):
        checkpoint.load(path, start("toy"))


def test_missing_files_are_refused(tmp_path):
    with pytest.raises(ValueError, match=r"none\.npz' is not a saved state"):
        checkpoint.load(tmp_path / "none.npz", start("toy"))


def test_a_changed_byte_is_noticed(tmp_path):
    path = tmp_path / "state.npz"
    checkpoint.save(path, start("toy"))
    content = bytearray(path.read_bytes())
    place = content.find(np.asarray(start("toy").position).tobytes())
    content[place] ^= 1
    path.write_bytes(bytes(content))
    with pytest.raises(ValueError, match="is not a saved state"):
        checkpoint.load(path, start("toy"))


def test_states_of_another_run_are_refused(tmp_path):
    path = tmp_path / "state.npz"
    checkpoint.save(path, start("toy"))
    message = r"does not belong to this run: .*position is float64\[3\], expected float64\[4\]"
    with pytest.raises(ValueError, match=message):
        checkpoint.load(path, toy_init(jax.random.key(0), jnp.zeros(4), 0.1))
    with pytest.raises(ValueError, match=r"does not belong to this run: .* is missing"):
        checkpoint.load(path, start("cce"))
    with pytest.raises(ValueError, match="Delete the file to start afresh"):
        run_in_chunks(
            toy_step,
            start("toy"),
            jnp.zeros(3),
            0.1,
            num_steps=3,
            options=ChunkOptions(checkpoint=path),
        )


def test_a_state_of_another_problem_is_refused(tmp_path):
    """Of the same shapes; the message says what differs."""
    path = tmp_path / "state.npz"
    given = checkpoint.fingerprint(problem={"map": np.arange(9)}, hparams=0.5)
    checkpoint.save(path, start("toy"), given)
    other = checkpoint.fingerprint(problem={"map": np.arange(9) + 1}, hparams=0.5)
    with pytest.raises(ValueError, match=r"problem\['map'\] was int64\[9\] #\w+ and is int64"):
        checkpoint.load(path, start("toy"), other)
    other = checkpoint.fingerprint(problem={"map": np.arange(9)}, hparams=0.25)
    with pytest.raises(ValueError, match=r"hparams was 0\.5 and is 0\.25.*Delete the file"):
        checkpoint.load(path, start("toy"), other)
    with pytest.raises(ValueError, match="is not given"):
        checkpoint.load(path, start("toy"))


def test_an_axis_of_length_zero_stands_for_any(tmp_path):
    path = tmp_path / "rows.npz"
    checkpoint.save(path, np.ones((3, 2)))
    assert checkpoint.load(path, np.zeros((0, 2))).shape == (3, 2)
    with pytest.raises(ValueError, match="does not belong"):
        checkpoint.load(path, np.zeros((0, 3)))


def outer(number):
    def inner(x):
        return x in {"a", "b", "c"} and number

    return inner


def test_what_tells_fingerprints_apart():
    def one(**given):
        return checkpoint.fingerprint(**given)

    assert one(x=np.float32(1)) != one(x=np.float64(1))
    assert one(x=np.zeros((2, 3))) != one(x=np.zeros((3, 2)))
    assert one(x=jax.random.key(0)) != one(x=jax.random.key(1))
    assert one(x=outer(1)) != one(x=outer(2))
    assert one(x=outer(1)) == one(x=outer(1))
    assert one(x=jax.tree_util.Partial(outer, 1)) != one(x=jax.tree_util.Partial(outer, 2))
    assert one(x=None) != one(x=0) != one(x=False)
    nets = [behavioral_cloning.DensePolicy(hidden=h) for h in ((4,), (5,), (4,))]
    assert one(x=nets[0]) != one(x=nets[1])
    assert one(x=nets[0]) == one(x=nets[2])


def test_functions_are_told_apart_by_their_text_and_not_by_bytecode(tmp_path, monkeypatch):
    """Bytecode changes with minor versions of Python."""

    def module(name, text):
        (tmp_path / f"{name}.py").write_text(text)
        code = compile(text, str(tmp_path / f"{name}.py"), "exec")
        names = {"__name__": "world"}
        exec(code, names)
        return {x: checkpoint.fingerprint(x=f) for x, f in names.items() if callable(f)}

    first = "def step(x):\n    return x + 1\n"
    second = "# moved\n\ndef step(x):\n    'Adds one.'\n    return (x +  1)  # here\n"
    one, other = (
        "pair = [lambda x: x + 1, lambda x: x + 2]\nfirst, second = pair\n",
        "f = lambda x: 3\n",
    )
    assert module("a", first) == module("b", second)
    assert module("a", first) != module("c", first.replace("1", "2"))
    lambdas = module("d", one)
    assert lambdas["first"] != lambdas["second"]
    monkeypatch.setattr(checkpoint, "_constant", None)  # of bytecode
    assert module("e", first) and module("f", other) == module("g", f"\n{other}")


@pytest.mark.slow
def test_another_process_finds_the_same_fingerprint():
    program = (
        "import jax; jax.config.update('jax_enable_x64', True)\n"
        "from jaxltl.algos.common import checkpoint\n"
        "from tests.algos.test_checkpoint import outer\n"
        "print(checkpoint.fingerprint(x=outer(3), y=jax.numpy.arange(3)))"
    )
    found = {
        subprocess.run(
            [sys.executable, "-c", program],
            capture_output=True,
            text=True,
            check=True,
            env={**os.environ, "PYTHONHASHSEED": seed, "PYTHONPATH": os.getcwd()},
        ).stdout
        for seed in ("1", "2")
    }
    assert found == {f"{checkpoint.fingerprint(x=outer(3), y=jnp.arange(3))}\n"}


def test_unwritable_places_are_refused(tmp_path):
    with pytest.raises(ValueError, match=r"cannot write .*none/state\.npz.*choose a directory"):
        checkpoint.save(tmp_path / "none" / "state.npz", start("toy"))
    (tmp_path / "file").write_text("")
    with pytest.raises(ValueError, match="cannot write"):
        checkpoint.save(tmp_path / "file" / "state.npz", start("toy"))


def test_a_write_that_fails_leaves_the_old_file(tmp_path, monkeypatch):
    path = tmp_path / "state.npz"
    checkpoint.save(path, start("toy"))
    before = path.read_bytes()

    def fail(file, **arrays):
        file.write(b"half of it")
        raise OSError("no space left on device")

    monkeypatch.setattr(checkpoint.np, "savez", fail)
    with pytest.raises(OSError, match="no space left"):
        checkpoint.save(path, start("toy", 1))
    assert path.read_bytes() == before
    assert os.listdir(tmp_path) == ["state.npz"], "nothing half-written stays"


def test_an_interrupted_write_leaves_the_old_file(tmp_path):
    path = tmp_path / "file"
    path.write_bytes(b"old")
    with pytest.raises(KeyboardInterrupt), checkpoint.atomic_write(path) as file:
        file.write(b"new")
        raise KeyboardInterrupt
    assert path.read_bytes() == b"old"
    assert os.listdir(tmp_path) == ["file"]
    with checkpoint.atomic_write(path) as file:
        file.write(b"new")
        assert path.read_bytes() == b"old", "not before it is complete"
    assert path.read_bytes() == b"new"


def test_a_full_disk_names_the_file(tmp_path):
    full = r"cannot write '.*large.npz': No space left.*free some"
    with pytest.raises(ValueError, match=full), atomic_write(tmp_path / "large.npz"):
        raise OSError(errno.ENOSPC, "No space left on device")
    assert list(tmp_path.iterdir()) == []
    with pytest.raises(OSError, match="busy"), atomic_write(tmp_path / "large.npz"):
        raise OSError(errno.EBUSY, "busy")
