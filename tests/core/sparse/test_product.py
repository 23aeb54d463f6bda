"""Products of sparse rows, against a search pair by pair, and where runs of them are accepted."""

import itertools

import numpy as np
import pytest

from jaxltl.core.sparse import product as module
from jaxltl.core.sparse.graph.accepting import accepting_region
from jaxltl.core.sparse.graph.qualitative import shortest_path_rows
from jaxltl.core.sparse.mdp import HostMDP
from jaxltl.core.sparse.product import sparse_product


def random_host(rng, num_states, most_rows=2, most_entries=3) -> HostMDP:
    rows = rng.integers(1, most_rows + 1, num_states)
    width = rng.integers(1, min(most_entries, num_states) + 1, rows.sum())
    successor = [np.sort(rng.choice(num_states, w, replace=False)) for w in width]
    return HostMDP(
        np.append(0, rows.cumsum()).astype(np.int32),
        np.append(0, width.cumsum()),
        np.concatenate(successor).astype(np.int32),
        np.repeat(1 / width, width),
    )


def lines(mdp: HostMDP, state: int) -> list[dict]:
    """The choices of a state, each a distribution."""
    return [
        {
            int(mdp.successor[e]): float(mdp.probability[e])
            for e in range(mdp.entry_start[r], mdp.entry_start[r + 1])
        }
        for r in range(mdp.row_start[state], mdp.row_start[state + 1])
    ]


def searched(mdp, delta, letter, starts, on_entry, still):
    """What is reached of the product, pair by pair."""
    found, todo = {}, list(starts)
    while todo:
        s, q = pair = todo.pop()
        if pair in found:
            continue
        if still[q]:
            found[pair] = [{pair: 1.0}]
            continue
        found[pair] = [
            {(t, int(delta[q, letter[t if on_entry else s]])): p for t, p in line.items()}
            for line in lines(mdp, s)
        ]
        todo += [pair for line in found[pair] for pair in line]
    return found


@pytest.mark.parametrize("way", ["frontier", "search", "few numbers"])
@pytest.mark.parametrize("on_entry", [True, False])
def test_products_are_what_a_search_finds(on_entry, way, monkeypatch):
    if way == "search":
        monkeypatch.setattr(module, "_ROUNDS", 1)
    if way == "few numbers":
        monkeypatch.setattr(module, "_DENSE", 0)
    rng = np.random.default_rng(7)
    for _ in range(40):
        num_states, num_memory, num_letters = rng.integers(1, [9, 5, 4])
        mdp = random_host(rng, num_states)
        delta = rng.integers(0, num_memory, (num_memory, num_letters))
        letter = rng.integers(0, num_letters, num_states)
        state = rng.integers(0, num_states, rng.integers(1, 3))
        memory = rng.integers(0, num_memory, state.size)
        still = rng.random(num_memory) < 0.3
        found = sparse_product(mdp, delta, letter, (state, memory), on_entry=on_entry, still=still)
        starts = list(zip(state.tolist(), memory.tolist(), strict=True))
        wanted = searched(mdp, delta, letter, starts, on_entry, still)
        pairs = list(zip(found.base_state.tolist(), found.memory.tolist(), strict=True))
        assert pairs == sorted(wanted)
        assert [pairs[i] for i in found.start] == starts
        assert found.still.tolist() == [still[q] for _, q in pairs]
        for i, pair in enumerate(pairs):
            shown = [{pairs[t]: p for t, p in line.items()} for line in lines(found.host, i)]
            assert shown == wanted[pair]
            rows = range(found.host.row_start[i], found.host.row_start[i + 1])
            first = mdp.row_start[pair[0]]
            assert found.base_row[list(rows)].tolist() == [first + k for k in range(len(rows))]
        ascending = np.diff(found.host.successor) > 0
        ascending[found.host.entry_start[1:-1] - 1] = True
        assert ascending.all()
        read = found.entry_letter(letter, on_entry)
        source = found.base_state[found.host.state[found.host.row]]
        target = found.base_state[found.host.successor]
        assert (read == letter[target if on_entry else source]).all()


def test_a_deep_product_is_handed_over():
    """A line of states, one a round; the search takes over and finds the same."""
    size = 5000
    mdp = HostMDP(
        np.arange(size + 1, dtype=np.int32),
        np.arange(size + 1),
        np.append(np.arange(1, size), 0).astype(np.int32),
        np.ones(size),
    )
    found = sparse_product(mdp, np.array([[1], [0]]), np.zeros(size, int), ([0], [0]))
    assert found.base_state.size == size  # an even ring: memory goes with the place
    assert (found.memory == found.base_state % 2).all()
    assert (found.host.successor == np.append(np.arange(1, size), 0)).all()


def test_products_beyond_all_bounds_are_refused():
    size = 2**20
    mdp = HostMDP(
        np.arange(size + 1, dtype=np.int32),
        np.arange(size + 1),
        np.arange(size, dtype=np.int32),
        np.ones(size),
    )
    with pytest.raises(ValueError, match="smaller formula"):
        sparse_product(mdp, np.zeros((4096, 1), int), np.zeros(size, int), ([0], [0]))


# --- acceptance -------------------------------------------------------------------------------


def joined(states, edges) -> bool:
    """Whether edges lead from each of some states to each other."""

    def reach(start):
        seen, todo = {start}, [start]
        while todo:
            for a, b in edges:
                if a == todo[-1] and b not in seen:
                    seen.add(b)
                    todo.insert(0, b)
            todo.pop()
        return seen

    return all(reach(s) == states for s in states)


def accepted_by_subsets(mdp, priority):
    """The states of all end components, of any rows, whose least priority is even."""
    found = set()
    for rows in itertools.chain.from_iterable(
        itertools.combinations(range(mdp.num_rows), k) for k in range(1, mdp.num_rows + 1)
    ):
        entries = [e for r in rows for e in range(mdp.entry_start[r], mdp.entry_start[r + 1])]
        states = {int(mdp.state[r]) for r in rows}
        edges = {(int(mdp.state[mdp.row[e]]), int(mdp.successor[e])) for e in entries}
        if (
            {t for _, t in edges} <= states
            and joined(states, edges)
            and (priority[entries].min() % 2 == 0)
        ):
            found |= states
    return found


@pytest.mark.parametrize("most", [2, 5])
def test_accepting_regions_are_those_of_all_end_components(most):
    rng = np.random.default_rng(most)
    some = 0
    for _ in range(60):
        mdp = random_host(rng, rng.integers(1, 6), most_entries=2)
        priority = rng.integers(0, most, mdp.num_transitions)
        found = accepting_region(mdp, priority)
        assert set(np.flatnonzero(found.region).tolist()) == accepted_by_subsets(mdp, priority)
        some += found.region.any() and not found.region.all()
        # By its own rows the region is never left, and all that recurs there is accepted.
        inside = np.flatnonzero(found.region)
        taken = found.row[inside]
        assert (mdp.state[found.row] == np.arange(mdp.num_states)).all()
        chain = HostMDP(np.arange(mdp.num_states + 1, dtype=np.int32), *_rows(mdp, found.row))
        entry = np.concatenate([_entries(mdp, r) for r in found.row])
        bottom = _bottom_components(chain, set(inside.tolist()))
        assert np.isin(
            mdp.successor[np.concatenate([_entries(mdp, r) for r in taken] or [[]]).astype(int)],
            inside,
        ).all()
        for component in bottom:
            read = [priority[entry[e]] for s in component for e in _entries(chain, s)]
            assert min(read) % 2 == 0
    assert some > 5


def _entries(mdp, row):
    return np.arange(mdp.entry_start[row], mdp.entry_start[row + 1])


def _rows(mdp, rows):
    entry = [_entries(mdp, r) for r in rows]
    start = np.append(0, np.cumsum([e.size for e in entry]))
    entry = np.concatenate(entry)
    return start, mdp.successor[entry], mdp.probability[entry]


def _bottom_components(chain, states):
    """Closed sets of states of a chain that lead to one another."""
    after = {s: set(chain.successor[_entries(chain, s)].tolist()) for s in states}
    for _ in states:
        after = {s: {s} | a | {u for t in a for u in after.get(t, ())} for s, a in after.items()}
    return {frozenset(a) for s, a in after.items() if a <= states and all(after[t] == a for t in a)}


def test_ways_lead_nearer():
    rng = np.random.default_rng(3)
    for _ in range(40):
        mdp = random_host(rng, 7)
        goal, rows = rng.random(7) < 0.3, rng.random(mdp.num_rows) < 0.7
        distance = np.where(goal, 0, 99)
        for _ in range(7):
            for r in np.flatnonzero(rows):
                near = distance[mdp.successor[_entries(mdp, r)]].min() + 1
                distance[mdp.state[r]] = min(distance[mdp.state[r]], near)
        taken = shortest_path_rows(mdp, goal, rows)
        assert (mdp.state[taken] == np.arange(7)).all()
        for s in np.flatnonzero(~goal & (distance < 99)):
            assert rows[taken[s]]
            assert distance[mdp.successor[_entries(mdp, taken[s])]].min() == distance[s] - 1
