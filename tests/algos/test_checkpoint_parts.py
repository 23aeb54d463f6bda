"""Arrays in parts: any block is read back, whatever devices they were saved from."""

import itertools

import numpy as np
import pytest

from jaxltl.algos.common import checkpoint as parts


def written(path, array, cuts):
    """An array in a part for each of its blocks between cuts of every axis."""
    ends = [
        list(itertools.pairwise((0, *cut, size)))
        for cut, size in zip(cuts, array.shape, strict=True)
    ]
    pieces = []
    for i, block in enumerate(itertools.product(*ends)):
        begin, end = [list(x) for x in zip(*block, strict=True)]
        name = f"{path.name}.part-{i}-x"
        with path.with_name(name).open("wb") as file:
            np.savez(file, x=array[tuple(map(slice, begin, end))])
        pieces.append((begin, end, name, "x"))
    return parts._Stored(list(array.shape), str(array.dtype), pieces)


@pytest.mark.parametrize("cuts", [((3,), ()), ((1, 2, 5), (2,)), ((), ())])
def test_any_block_is_read_from_any_pieces(tmp_path, cuts):
    array = np.random.default_rng(0).normal(size=(7, 4))
    stored = written(tmp_path / "run.npz", array, cuts)
    with parts._ArrayParts(tmp_path / "run.npz") as found:
        np.testing.assert_array_equal(found.read(stored), array)
        for a, b in itertools.combinations(range(8), 2):
            np.testing.assert_array_equal(found.read(stored, (slice(a, b),)), array[a:b])
            np.testing.assert_array_equal(
                found.read(stored, (slice(a, b), slice(1, None))), array[a:b, 1:]
            )


def test_only_the_parts_that_are_needed_are_read(tmp_path):
    array = np.arange(12.0).reshape(6, 2)
    stored = written(tmp_path / "run.npz", array, ((2, 4), ()))
    (tmp_path / stored.pieces[0][2]).unlink()
    (tmp_path / stored.pieces[1][2]).write_bytes(b"PK of no use")
    with parts._ArrayParts(tmp_path / "run.npz") as found:
        np.testing.assert_array_equal(found.read(stored, (slice(4, 6),)), array[4:])
        with pytest.raises(ValueError, match=r"its part 'run.npz.part-0-x' is missing"):
            found.read(stored)
        with pytest.raises(ValueError, match=r"its part 'run.npz.part-1-x' is damaged"):
            found.read(stored, (slice(2, 6),))


def test_what_lies_beside_a_file_is_its_own_alone(tmp_path):
    mine = [tmp_path / "a[1].npz.part-0-x", tmp_path / "a[1].npz.part-1-y"]
    begun, others = tmp_path / ".a[1].npz.part-0-x.tmp", tmp_path / "a1.npz.part-0-x"
    for path in (*mine, begun, others):
        path.touch()
    assert parts._parts_of(tmp_path / "a[1].npz") == mine
    assert parts._unfinished(tmp_path / "a[1].npz") == [begun]
    parts._unlink([*mine, begun, tmp_path / "not there"])
    assert list(tmp_path.iterdir()) == [others]
