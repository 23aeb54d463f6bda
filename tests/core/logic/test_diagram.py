"""Decision diagrams against truth tables."""

import random
from itertools import product

import pytest

from jaxltl.core.logic.diagram import FALSE, TRUE, Diagrams, prime_cubes

WIDTH = 4
ROWS = list(product([False, True], repeat=WIDTH))
EVERYTHING = (1 << len(ROWS)) - 1  # truth tables are bit masks over ROWS


def random_function(rng, diagrams, size):
    """A diagram and its truth table, built by random operations."""
    if size == 0:
        variable = rng.randrange(WIDTH)
        table = sum(1 << i for i, row in enumerate(ROWS) if row[variable])
        return diagrams.node(variable, FALSE, TRUE), table
    left, of_left = random_function(rng, diagrams, size - 1)
    right, of_right = random_function(rng, diagrams, rng.randrange(size))
    test, of_test = random_function(rng, diagrams, 0)
    return rng.choice(
        [
            (diagrams.both(left, right), of_left & of_right),
            (diagrams.either(left, right), of_left | of_right),
            (diagrams.negation(left), EVERYTHING & ~of_left),
            (diagrams.choice(test, left, right), of_test & of_left | ~of_test & of_right),
        ]
    )


def value(diagrams, diagram, row):
    while diagram not in (FALSE, TRUE):
        variable, low, high = diagrams.nodes[diagram]
        diagram = high if row[variable] else low
    return diagram == TRUE


def table_of(cubes):
    return sum(
        1 << i
        for i, row in enumerate(ROWS)
        if any(all(row[variable] == said for variable, said in cube) for cube in cubes)
    )


def test_equal_iff_equivalent():
    rng, diagrams = random.Random(0), Diagrams()
    seen = {}
    for _ in range(1500):
        diagram, table = random_function(rng, diagrams, rng.randint(0, 6))
        assert seen.setdefault(table, diagram) == diagram
        assert table == sum(value(diagrams, diagram, row) << i for i, row in enumerate(ROWS))
    assert len(set(seen.values())) == len(seen) > 150
    assert seen[0] == FALSE and seen[EVERYTHING] == TRUE


def test_nodes_are_ordered_and_distinct():
    rng, diagrams = random.Random(1), Diagrams()
    for _ in range(300):
        random_function(rng, diagrams, 5)
    assert len(set(diagrams.nodes)) == len(diagrams.nodes)
    for variable, low, high in diagrams.nodes[2:]:
        assert low != high
        assert variable < min(diagrams.nodes[low][0], diagrams.nodes[high][0])


def test_cofactors_are_the_halves():
    rng, diagrams = random.Random(2), Diagrams()
    for _ in range(200):
        diagram, _ = random_function(rng, diagrams, 5)
        top = diagrams.nodes[diagram][0] if diagram > TRUE else 0
        halves = diagrams.cofactors(diagram, top)
        for row in ROWS:
            assert value(diagrams, halves[row[top]], row) == value(diagrams, diagram, row)


def test_prime_cubes_cover_exactly():
    rng, diagrams = random.Random(3), Diagrams()
    sizes = set()
    for _ in range(400):
        first, of_first = random_function(rng, diagrams, rng.randint(0, 6))
        second, of_second = random_function(rng, diagrams, rng.randint(0, 6))
        lower, upper = diagrams.both(first, second), first
        cubes, cover = prime_cubes(lower, upper, diagrams)
        covered = table_of(cubes)
        assert covered == sum(value(diagrams, cover, row) << i for i, row in enumerate(ROWS))
        assert of_first & of_second & ~covered == 0 and covered & ~of_first == 0
        for i, cube in enumerate(cubes):
            rest = table_of(cubes[:i] + cubes[i + 1 :])
            assert of_first & of_second & ~rest, "a cube to spare"
            for k in range(len(cube)):
                assert table_of([cube[:k] + cube[k + 1 :]]) & ~of_first, "a literal to spare"
        exact, same = prime_cubes(first, first, diagrams)
        assert same == first and table_of(exact) == of_first
        sizes.add(len(exact))
    assert max(sizes) >= 4


def test_too_many_nodes():
    diagrams = Diagrams(max_nodes=5)
    first, second, third = (diagrams.node(v, FALSE, TRUE) for v in range(3))
    with pytest.raises(ValueError, match="more than 5"):
        diagrams.both(diagrams.either(first, second), third)
