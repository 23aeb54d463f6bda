"""Checks a certificate by exact arithmetic, without jaxltl: ``python checker.py FILE``.

It shares no code with the solvers and prints ACCEPTED (exit status 0), REFUSED and why (1), or why
the file is no certificate (2). docs/certificates.md has the format and derives every condition.

A node is a state s with an automaton state q and a memory state m, numbered (s Q + q) M + m. An
option of it is a tuple: successors, numerators of their (least) probabilities, the denominator,
greatest numerators if the probabilities are intervals (or None), rewards (or none), and of
intervals the parts (begin, end, mass) that are rows: several if a randomised policy mixes them.
"""

from __future__ import annotations

import argparse
import functools
import gc
import gzip
import io
import json
import math
import re
import sys
import tarfile
from array import array
from collections.abc import Callable, Iterable, Iterator, Sequence
from fractions import Fraction
from itertools import compress, groupby
from operator import add, ge, itemgetter, le, mul, or_, sub
from typing import Any

LARGEST_TABLEAU = 20_000  # states of the product that compares automaton and formula
NUMBERS = "exact values, normalised rows"
OTHER = {"max": "min", "min": "max"}
CODES = {"uint32": "I", "uint64": "Q", "double64": "d"}  # of the module array
# Keys and types of tables in the index; "?" marks optional keys. A formula is the name of a label
# or a list of an operator and its operands.
INDEX = "version:int producer:str numbers:str question:dict claims:list members:dict counts?:dict"
RULE = " policy?:str memory?:int next?:str"
QUESTION = "text:str path:dict objective:str nature?:str environment?:str observations?:str"
QUESTION += " initial?:str" + RULE
CLAIM = "side:str bound:str values:str beliefs?:dict" + RULE
BELIEFS = "vectors:str covers:str values:str"
COUNTS = "member:str method:str confidence:str assumption:str"
PATHS = {
    "until": "kind:str target:str|list stay?:str|list steps?:int",
    "reward": "kind:str target:str|list reward:str",
    "total": "kind:str reward:str steps?:int discount?:str",
    "formula": "kind:str formula:str|list automaton:str",
}
QUOTED = r'"(?:[^"\\]|\\.)*"'  # a name in HOA
DUAL = {"&": "|", "|": "&", "U": "R", "R": "U", "X": "X"}  # operators of negations
DERIVED: dict[str, Callable] = {
    "true": lambda: ["&"],
    "false": lambda: ["|"],
    "F": lambda f: ["U", ["true"], f],
    "G": lambda f: ["R", ["false"], f],
    "->": lambda f, g: ["|", ["!", f], g],
    "<->": lambda f, g: ["|", ["&", f, g], ["&", ["!", f], ["!", g]]],
    "W": lambda f, g: ["R", g, ["|", f, g]],
}


class Refusal(Exception):
    """A condition does not hold."""


def need(condition: object, why: str, error: type[Exception] = ValueError) -> None:
    """Raises an error with a reason unless a condition holds."""
    if not condition:
        raise error(why)


hold = functools.partial(need, error=Refusal)


# --- reading --------------------------------------------------------------------------------------
def read_archive(path: str, limit: int) -> dict[str, bytes]:
    """Contents of the regular files of a tar archive, plain or gzipped, by name."""
    data, contents = bytearray(), {}
    with open(path, "rb") as plain:
        file: Any = gzip.GzipFile(fileobj=plain) if plain.peek(2)[:2] == b"\x1f\x8b" else plain
        while piece := file.read(2**20):
            data += piece
            need(len(data) <= limit, f"the archive has more than {limit} bytes; see --limit")
    with tarfile.open(fileobj=io.BytesIO(data), mode="r:") as archive:
        for info in archive:
            if not info.isdir():
                name, end = info.name.lstrip("./"), info.offset_data + info.size
                is_whole = info.isreg() and not info.issparse() and end <= len(data)
                is_whole = is_whole and name not in contents and info.size >= 0
                need(is_whole, f"{name!r:.80} is cut off, no file, or there twice")
                contents[name] = bytes(data[info.offset_data : end])
    return contents


def read_json(contents: dict[str, bytes], name: str) -> Any:
    """A member in JSON, without repeated keys; numbers with a point remain text."""

    def unique(items: list[tuple[str, object]]) -> dict:
        need(len(dict(items)) == len(items), f"{name}: a key is given twice")
        return dict(items)

    text = contents.get(name, b"")
    need(0 < len(text) < 2**20, f"{name} is missing or has over 1 MiB")
    return json.loads(text, object_pairs_hook=unique, parse_float=str)


def record(table: Any, spec: str) -> dict:
    """A table with the declared keys; others, which could change the meaning, are refused."""
    need(type(table) is dict, f"a table with {spec} is none")
    kinds = {key.rstrip("?"): kind for key, kind in (x.split(":") for x in spec.split())}
    for key, value in table.items():
        is_known = type(value).__name__ in kinds.get(key, "").split("|")
        fits = is_known and not (type(value) is int and value < 0)
        need(fits, f"{key!r:.80} is unknown to version 1, or has a wrong value")
    missing = [key for key in kinds if key not in table and f"{key}?" not in spec]
    need(not missing, f"{missing[:1]} is missing")
    return table


def read_numbers(contents: dict, name: str, dtype: str, count: int, default: Any = ()) -> Sequence:
    """The little-endian numbers of a member; doubles are read and never computed with."""
    if default and f"{name}.bin" not in contents:
        return default
    data, bits = contents.get(f"{name}.bin", b""), int(re.sub(r"\D", "", dtype)[:5] or 0)
    is_known = dtype in CODES or (dtype == f"rational{bits}" and bits % 128 == 0 < bits)
    fits = is_known and len(data) == bits // 8 * count
    need(fits, f"{name:.80} has {len(data)} bytes; expected {count} numbers {dtype:.40}")
    if dtype in CODES:
        values = array(CODES[dtype], data)
        if sys.byteorder == "big":
            values.byteswap()
        return values
    size = bits // 16
    parts = [data[i : i + size] for i in range(0, len(data), size)]
    above = [int.from_bytes(x, "little", signed=True) for x in parts[::2]]
    return list(map(Fraction, above, [int.from_bytes(x, "little") for x in parts[1::2]]))


def to_fraction(text: str) -> Fraction:
    """The number that a text of bounded length denotes, a decimal or a quotient."""
    number = r"-?\d{1,4000}(\.\d{1,4000})?(e[+-]?\d{1,3}|/0*[1-9]\d{0,3999})?"
    need(re.fullmatch(number, text, re.ASCII), f"{text!r:.40} is no number such as 0.25 or 1/4")
    return Fraction(text)


def to_integers(*lists: Iterable) -> tuple[list[list], int]:
    """Lists of numbers as integers over one common denominator, or as fractions if it is huge."""
    ratios = [[x.as_integer_ratio() for x in values] for values in lists]
    common = 1
    for d in {d for values in ratios for _, d in values}:
        common = math.lcm(common, d)
        if common.bit_length() > 4096:
            return [[Fraction(n, d) for n, d in values] for values in ratios], 1
    return [[n * (common // d) for n, d in values] for values in ratios], common


@functools.lru_cache(2**16)
def distribution(*ends: tuple) -> tuple[list, int, list | None]:
    """Numerators of probabilities n_t / sum(n), or of the ends of intervals; and a denominator."""
    (low, *high), common = to_integers(*ends)
    if not high:
        hold(sum(low), "all probabilities of a row are 0")
        return low, sum(low), None
    fits = sum(low) <= common <= sum(high[0]) and all(map(le, low, high[0]))
    hold(fits, "no distribution lies within the intervals of a row")
    return low, common, high[0]


class UmbModel:
    """A model of a UMB archive."""

    def __init__(self, contents: dict[str, bytes]) -> None:
        self.contents, index = contents, read_json(contents, "index.json")
        system, self.annotations = index["transition-system"], index.get("annotations", {})
        version = index["format-version"], system.get("time", "discrete")
        need(version == (1, "discrete"), f"version and time {version!s:.40} are not covered")
        counts = (system[f"#{x}"] for x in ("states", "choices", "branches", "players"))
        states, rows, branches, players = counts
        target = read_numbers(contents, "branch-to-target", "uint64", branches)
        fits = 0 < states <= rows <= branches and max(target) < states
        need(fits, "a state or choice has no successor")
        self.row_start = self._starts("state-to-choices", states, rows)
        self.branch_start = self._starts("choice-to-branches", rows, branches)
        ends = self._reals("branch-to-probability", system["branch-probability-type"], branches)
        hold(min(ends[0]) >= 0, f"a probability is {min(ends[0])}")
        pairs = zip(self.branch_start, self.branch_start[1:])
        self.rows = [(target[a:b], *distribution(*[tuple(x[a:b]) for x in ends])) for a, b in pairs]
        # The player that chooses: 0 the system, 1 the environment, 2 nobody.
        default = [0] * states if players < 2 else ()
        owner = read_numbers(contents, "state-to-player", "uint32", states, default)
        need(max(owner) < max(1, players), "a state is owned by no player of the model")
        sizes = map(sub, self.row_start[1:], self.row_start)
        self.owner = [x if size > 1 else 2 for x, size in zip(owner, sizes)]
        need(players < 3, "a model of more than two players is not covered")
        self.opponents = {"nature": len(ends) > 1, "environment": players > 1}
        self.num_states = states
        self.observation: Sequence = array("Q")
        if system.get("#observations"):
            place = system.get("observations-apply-to"), "observation-probability-type" in system
            need(place == ("states", False), "observations that are no numbers of states")
            name = "observations/states/values"
            self.observation = read_numbers(contents, name, "uint64", states)
        self.initial = self._bits("state-is-initial", [2**64 - 1] * states)
        need(True in self.initial, "no state is initial")

    def _starts(self, name: str, count: int, total: int) -> Sequence:
        default = range(count + 1) if count == total else ()
        starts = read_numbers(self.contents, name, "uint64", count + 1, default)
        increases = not any(map(le, starts[1:], starts))
        need(increases and (starts[0], starts[-1]) == (0, total), f"{name} does not increase")
        return starts

    def _bits(self, name: str, default: Sequence = ()) -> list[bool]:
        count = -(-self.num_states // 64)
        words = read_numbers(self.contents, name, "uint64", count, default)
        return [bool(words[s >> 6] >> (s & 63) & 1) for s in range(self.num_states)]

    def _reals(self, name: str, table: dict, count: int) -> list[Sequence]:
        """Numbers, or lower and upper ends of intervals."""
        word = table["type"].replace("-interval", "")
        ends = 1 if word == table["type"] else 2
        bits = table.get("size", (128 if word == "rational" else 64) * ends) // ends
        values = read_numbers(self.contents, name, f"{word}{bits}", count * ends)
        return [values[i::ends] for i in range(ends)]

    def _annotation(self, name: str, *groups: str) -> tuple[str, dict]:
        """Folder and description of the annotation with a name."""
        tables = [(g, k, table) for g in groups for k, table in self.annotations.get(g, {}).items()]
        places = [(f"annotations/{g}/{k}", x) for g, k, x in tables if x.get("alias", k) == name]
        need(len(places) == 1, f"the model has {len(places)} labels or rewards {name!r:.80}")
        return places[0]

    def label(self, name: str) -> list[bool]:
        """The states with a label."""
        return self._bits(self._annotation(name, "aps", "other-aps")[0] + "/states/values")

    def reward(self, name: str) -> list[list]:
        """Rewards of branches: of their states, of their rows, and their own."""
        folder, table = self._annotation(name, "rewards")
        starts: dict = {"states": [self.branch_start[r] for r in self.row_start]}
        starts |= {"choices": self.branch_start, "branches": range(self.branch_start[-1] + 1)}
        parts = []
        for part in {*table["applies-to"]}:
            begin, end = starts[part], starts[part][1:]
            values, *high = self._reals(f"{folder}/{part}/values", table["type"], len(end))
            need(high in ([], [values]), f"the reward {name!r:.80} has intervals")
            parts.append([x for x, a, b in zip(values, begin, end) for _ in range(b - a)])
        return parts


# --- graphs ---------------------------------------------------------------------------------------
def explore(start: Iterable, expand: Callable, ends: Callable) -> dict:
    """The edges of all nodes that can be reached, where `ends` are the successors of an edge."""
    graph: dict = dict.fromkeys(start)
    pending = [*graph]
    for v in pending:  # the list grows
        graph[v] = expand(v)
        for edge in graph[v]:
            for t in ends(edge):
                if t not in graph:
                    graph[t] = None
                    pending.append(t)
    return graph


def sources(graph: dict) -> dict:
    """The nodes with an option from which a node is possible, for each such node."""
    result: dict = {}
    for v, options in graph.items():
        for option in options:
            for t in compress(option[0], option[3] or option[1]):
                result.setdefault(t, []).append(v)
    return result


def staying(graph: dict) -> dict:
    """The largest set of nodes that each have an option which stays in the set; with these options.

    Nature can stay where all least probabilities are, and the greatest ones add up to 1.
    """
    inside = {*graph}

    def stays(option: tuple) -> bool:
        targets, low, _, high, _, parts = option
        is_inner = [t in inside for t in targets]
        can_stay = all(sum(compress(high[a:b], is_inner[a:b])) >= mass for a, b, mass in parts)
        return can_stay and sum(compress(low, is_inner)) == sum(low)

    before, pending = sources(graph), [*graph]
    while pending:
        v = pending.pop()
        if v in inside and not any(map(stays, graph[v])):
            inside.discard(v)
            pending += before.get(v, ())
    return {v: [*filter(stays, options)] for v, options in graph.items() if v in inside}


def recurring(graph: dict, marks: Sequence[set]) -> dict:
    """The largest set of nodes from each of which each marked set can be reached, without leaving.

    Then some choices of options visit each marked set again and again almost surely.
    """
    kept, size = staying(graph), -1
    while len(kept) != size:
        size = len(kept)
        for marked in marks:
            before = sources(kept)
            start = marked & kept.keys()
            reaching = explore(start, lambda v, before=before: before.get(v, ()), lambda v: (v,))
            kept = staying({v: kept[v] for v in reaching})
    return kept


def accepting(graph: dict, priority: dict, parity: int, marks: Sequence[set], ends: bool) -> set:
    """Nodes from which marked sets and the least priority, of a parity, can recur almost surely.

    With `ends` without nodes that only lead to these: each follows one of the least priority.
    """
    union: set = set()
    for least in {p for p in priority.values() if p % 2 == parity}:
        part = {v: options for v, options in graph.items() if priority[v] >= least}
        sets = [{v for v in part if priority[v] == least}, *marks]
        kept, size = recurring(part, sets), -1
        while ends and len(kept) != size:
            size = len(kept)
            start = {
                t for v in sets[0] & kept.keys() for o in kept[v] for t in compress(o[0], o[1])
            }
            after = explore(start, kept.__getitem__, lambda o: compress(o[0], o[1]))
            kept = recurring({v: kept[v] for v in after}, sets)
        union |= kept.keys()
    return union


# --- formulas and automata ------------------------------------------------------------------------
def formula_text(formula: Any) -> str:
    """A formula with labels in quotes, and with parentheses around all inner operators."""
    if isinstance(formula, str):
        return json.dumps(formula, ensure_ascii=False)
    op, *parts = formula
    op = {"->": "=>", "<->": "<=>"}.get(op, op)
    texts = [formula_text(x) if isinstance(x, str) else f"({formula_text(x)})" for x in parts]
    return f" {op} ".join(texts) if len(parts) > 1 else " ".join([op, *texts])


class Tableau:
    """A formula of linear temporal logic and its negation, in negation normal form, by numbers."""

    def __init__(self, formula: Any) -> None:
        self.number: dict[tuple, int] = {}
        self.names: set[str] = set()
        self.size = 0
        self.root, self.negation = self._build(formula, True), self._build(formula, False)
        self.nodes, self.expand = [*self.number], functools.lru_cache(2**20)(self._expand)

    def _build(self, formula: Any, positive: bool) -> int:
        self.size += 1
        need(self.size < 2**16 and formula, "a formula is empty or too large")
        if isinstance(formula, str):
            self.names.add(formula)
            return self.number.setdefault(("ap", formula, positive), len(self.number))
        op, *parts = formula
        if op == "!" and len(parts) == 1:
            return self._build(parts[0], not positive)
        if op in DERIVED:
            return self._build(DERIVED[op](*parts), positive)
        fits = op in ("&", "|") or (op in DUAL and len(parts) == 1 + (op != "X"))
        need(fits, f"{op!r:.40} is no operator of {len(parts)} formulas")
        node = op if positive else DUAL[op], *(self._build(x, positive) for x in parts)
        return self.number.setdefault(node, len(self.number))

    def _expand(self, f: int, letter: frozenset[str]) -> list[tuple[frozenset[int], int]]:
        """Ways to satisfy a formula: the formulas for the next step, and bits of postponed untils."""
        op, *parts = self.nodes[f]
        if op == "ap":
            return [(frozenset(), 0)] * ((parts[0] in letter) == parts[1])
        if op == "X":
            return [(frozenset(parts), 0)]
        each = [self.expand(x, letter) for x in parts]
        waiting = [(frozenset([f]), (op == "U") << f)]
        if op == "&":
            return self.joint(each)
        if op == "|":
            return [*dict.fromkeys(way for ways in each for way in ways)]
        if op == "U":
            return each[1] + self.joint([each[0], waiting])
        return self.joint([each[1], each[0] + waiting])

    def joint(self, choices: Iterable[list]) -> list[tuple[frozenset[int], int]]:
        """Ways to satisfy several formulas together."""
        ways: list = [(frozenset(), 0)]
        for more in choices:
            if len(ways) * len(more) > LARGEST_TABLEAU:
                raise OverflowError
            ways = list(dict.fromkeys((a | c, b | d) for a, b in ways for c, d in more))
        return ways


class HoaAutomaton:
    """A deterministic parity automaton in HOA: the least priority that recurs is even, or odd."""

    LINE = re.compile(r"(?m)^(Start|States|AP|Acceptance):(.*)$")
    STATE = rf"State:\s*(\d{{1,6}})\s*(?:{QUOTED})?"
    ITEM = re.compile(rf"(?:{STATE}|\[([^\[\]]*)\]\s*(\d{{1,6}}))\s*(\{{[\d\s]*\}})?")

    def __init__(self, text: str, names: set[str], letters: Callable) -> None:
        head, _, rest = text.partition("--BODY--")
        body, end, tail = rest.partition("--END--")
        lines = {key: value.strip() for key, value in self.LINE.findall(head)}
        is_whole = text.startswith("HOA: v1") and end and not tail.strip() and len(head) < 2**16
        is_whole = is_whole and len(lines) == len(self.LINE.findall(head)) == 4
        need(is_whole, "no automaton in HOA with one line of Start, States, AP and Acceptance each")
        self.initial, states = int(lines["Start"]), range(int(lines["States"]))
        self.num_states = len(states)
        quoted = re.findall(QUOTED, lines["AP"])
        columns = [re.sub(r"\\(.)", r"\1", x[1:-1]) for x in quoted]
        self.letters, self.letter_of = letters(names | {*columns})
        # A chain such as Inf(0) | (Fin(1) & Inf(2)): the first set that recurs decides.
        condition, chain = re.sub(r"^\d+| ", "", lines["Acceptance"]), ""
        atoms = re.findall(r"(Inf|Fin)\((\d{1,6})\)", condition)
        for kind, number in reversed(atoms):
            rest = f"({chain})" if chain.count("(") > 1 else chain
            chain = f"{kind}({number})" + (rest and ("|" if kind == "Inf" else "&") + rest)
        need(condition in (chain, "t", "f"), f"{condition!r:.80} is no parity acceptance")
        priority_of = {x: 2 * i + (k == "Fin") for i, (k, x) in [*enumerate(atoms)][::-1]}
        last = atoms[-1][0] if atoms else condition
        self.default = 2 * len(atoms) + (last in ("Inf", "f"))
        # The successor and the priority of each state, by letters.
        self.edges: list[dict[int, tuple[int, int]]] = [{} for _ in self.letters]
        need(not self.ITEM.sub("", body).strip(), "the automaton has more than states and edges")
        q = marks = ""
        for state, label, successor, sets in self.ITEM.findall(body):
            if state:
                q, marks = state, sets
                continue
            recurring = re.findall(r"\d+", marks + sets)
            priorities = [priority_of.get(x, self.default) for x in recurring]
            edge = int(successor), min([self.default, *priorities])
            fits = self.initial in states and int(q) in states and edge[0] in states
            need(fits, f"the automaton has no initial state, or a wrong edge in state {q}")
            for term in re.sub(r"\s", "", label).split("|"):
                literals = [] if term == "t" else term.split("&")
                is_plain = all(re.fullmatch(r"!?\d{1,6}", x) for x in literals)
                need(is_plain, f"the label {label!r:.80} of the automaton is not like 0&!1 | 2")
                signs = [(columns[int(x.lstrip("!"))], x[0] != "!") for x in literals]
                for out, letter in zip(self.edges, self.letters):
                    if all((name in letter) == sign for name, sign in signs):
                        hold(out.setdefault(int(q), edge) == edge, f"state {q} has several edges")
        is_complete = all(len(out) == self.num_states for out in self.edges)
        hold(is_complete, "an automaton state has no edge for a letter of the model")

    def meets(self, parity: int, tableau: Tableau, f: int) -> bool:
        """True if some word satisfies a formula, and its run has a least priority of the parity.

        Emptiness of the product with the tableau, a generalised Buchi automaton: no until is
        postponed forever. A node has the priority and the postponed untils of the edge to it.
        """
        size = 0

        def expand(node: tuple) -> list[tuple]:
            nonlocal size
            edges = []
            for i, letter in enumerate(self.letters):
                q, priority = self.edges[i][node[0]]
                ways = tableau.joint([tableau.expand(x, letter) for x in node[1]])
                edges += [(q, rest, priority, postponed) for rest, postponed in ways]
            size += len(edges) + len(self.letters)
            if size > 20 * LARGEST_TABLEAU:
                raise OverflowError
            return edges

        graph = explore([(self.initial, frozenset([f]), self.default, 0)], expand, lambda v: (v,))
        postponed = functools.reduce(or_, (v[3] for v in graph))
        untils = [i for i in range(len(tableau.nodes)) if postponed >> i & 1]
        marks = [{v for v in graph if not v[3] >> i & 1} for i in untils]
        edges = {v: [((w,), (1,), 1, None, (), ()) for w in out] for v, out in graph.items()}
        return bool(accepting(edges, {v: v[2] for v in graph}, parity, marks, False))


# --- counts ---------------------------------------------------------------------------------------
@functools.lru_cache(2**16)
def excludes(method: str, k: int, n: int, x: Fraction, chance: Fraction) -> bool:
    """True if k of n excludes all probabilities up to x < k / n, with a chance of error."""
    if x * n >= k:
        return False
    (a, d), j = x.as_integer_ratio(), n - k
    if method == "hoeffding":  # exp(2 n (k/n - x)^2) >= 2 / chance, from below
        y, term, total, i = int(2 * n * (Fraction(k, n) - x) ** 2 * 2**64), 2**64, 0, 0
        while term and total * chance < 2**65 and i < 2**12:
            i, total = i + 1, total + term
            term = (term * y >> 64) // i
        return total * chance >= 2**65
    need(method in ("anytime", "clopper-pearson"), f"the method {method!r:.40} is unknown")
    # The tail of Clopper and Pearson, or the likelihood over the mixture of Jeffreys, a martingale.
    c = 2 if method == "anytime" else 1
    factors = [(c * (j + i) * a, (c * i + 1 - c) * d) for i in range(1, k + 1)]
    factors += [(c * i * (d - a), (c * i + 1 - c) * d) for i in range(1, j + 1)]
    mantissa, exponent = 2**320, -320  # of the product of the factors, rounded up to 320 bits
    for above, below in factors:
        mantissa = -(-mantissa * above // below)
        shift = mantissa.bit_length() - 320
        mantissa = -(-mantissa >> shift) if shift > 0 else mantissa << -shift
        exponent += shift
    total = term = mantissa
    for i in range(k, n if c == 1 else k):  # P(Bin(n, x) >= k), term by term
        term = -(-term * (n - i) * a // ((i + 1) * (d - a)))
        total += term
    return total * Fraction(2) ** exponent <= chance * c / 2


# --- the question ---------------------------------------------------------------------------------
def question_text(question: dict) -> str:
    """A question in the syntax of PRISM; what it has no syntax for follows as a comment."""
    path, objective = question["path"], question["objective"]
    bound = f"<={path['steps']}" if "steps" in path else ""
    inner = path.get("formula", [f"C{bound}"])
    if "target" in path:
        until = [f"U{bound}", path["stay"]] if "stay" in path else [f"F{bound}"]
        inner = [*until, path["target"]]
    head = f"R{{{json.dumps(path['reward'])}}}" if "reward" in path else "P"
    nature = {"adversarial": OTHER[objective], "cooperative": objective}
    head += objective + nature.get(question.get("nature", ""), "")
    players = {"adversarial": "<<system>> ", "cooperative": "<<system,environment>> "}
    head = players.get(question.get("environment", ""), "") + head
    notes = [f"discount {path['discount']}"] if "discount" in path else []
    notes += ["policies see observations"] if "observations" in question else []
    notes += ["of a given policy"] if "policy" in question else []
    notes += ["from a distribution of initial states"] if "initial" in question else []
    return f"{head}=? [ {formula_text(inner)} ]" + (f" // {', '.join(notes)}" if notes else "")


class CertificateFile:
    """A certificate: its model, its question and its claims."""

    def __init__(self, contents: dict[str, bytes]) -> None:
        index = record(read_json(contents, "certificate/index.json"), INDEX)
        self.contents, self.members, self.claims = contents, index["members"], index["claims"]
        is_known = (index["version"], index["numbers"]) == (1, NUMBERS) and self.claims
        need(is_known, f"no claims, or not of version 1 with numbers {NUMBERS!r}")
        self.model, self.question = UmbModel(contents), record(index["question"], QUESTION)
        self.path, objective = self.question["path"], self.question["objective"]
        self.kind = self.path.get("kind")
        hold(self.kind in PATHS, f"version 1 covers {', '.join(PATHS)}, not {self.kind!r:.40}")
        record(self.path, PATHS[self.kind])
        need(objective in OTHER, f"the objective {objective!r:.40} is neither max nor min")
        self.direction = {"system": objective}
        for player, exists in self.model.opponents.items():
            word = self.question.get(player)
            fits = word in (("adversarial", "cooperative") if exists else (None,))
            need(fits, f"{player} is {word!r:.40}, which does not fit the model")
            self.direction[player] = OTHER[objective] if word == "adversarial" else objective
        text = question_text(self.question)
        hold(self.question["text"] == text, f"the text of the question is not {text!r}")
        kinds, size = (("observations", "uint"), ("initial", "double")), [self.model.num_states]
        self.observation, self.weights = (
            self.array(self.question[key], **{kind: size}) if key in self.question else array("Q")
            for key, kind in kinds
        )
        fits = self.model.observation in (array("Q"), self.observation)
        need(fits, "the question has not the observations of the model")
        self.automaton, self.trusted, self.confidence, self.unproven = None, "", "", ""
        if "counts" in index:
            self.check_counts(record(index["counts"], COUNTS))
        if self.kind == "formula":
            tableau = Tableau(self.path["formula"])
            text = contents[f"certificate/{self.path['automaton']}.hoa"].decode()
            self.automaton = HoaAutomaton(text, tableau.names, self.letters)
            try:
                wrong = self.automaton.meets(0, tableau, tableau.negation)
                hold(not wrong, "the automaton accepts a word that violates the formula")
                wrong = self.automaton.meets(1, tableau, tableau.root)
                hold(not wrong, "the automaton rejects a word that satisfies the formula")
            except OverflowError:
                self.unproven = "the automaton, as its product with the tableau is too large"

    def letters(self, names: Iterable[str]) -> tuple[list[frozenset[str]], list[int]]:
        """The sets of propositions that hold in some state, and the number of each state's set."""
        columns = [[name if x else "" for x in self.model.label(name)] for name in sorted(names)]
        keys = list(zip(*columns)) or [()] * self.model.num_states
        number = {key: i for i, key in enumerate(dict.fromkeys(keys))}
        return [frozenset(key) for key in number], [number[key] for key in keys]

    def states(self, formula: Any) -> list[bool]:
        """The states in which a formula without temporal operators holds."""
        tableau = Tableau(formula)
        letters, letter_of = self.letters(tableau.names)
        ways = [tableau.expand(tableau.root, letter) for letter in letters]
        is_boolean = all(way == (frozenset(), 0) for some in ways for way in some)
        need(is_boolean, f"{formula_text(formula):.80} is temporal, and no set of states")
        return [bool(ways[i]) for i in letter_of]

    def array(self, name: str, **shapes: list[int]) -> Sequence:
        """An array of the certificate, of one of some kinds of numbers and their shape."""
        entry = record(self.members.get(name), "dtype:str shape:list")
        dtype, shape = entry["dtype"], entry["shape"]
        fits = shapes.get(dtype.rstrip("0123456789")) == shape
        need(fits, f"{name:.80} is {entry!s:.80}; expected {shapes}")
        dtype = "double64" if dtype == "double" else dtype
        return read_numbers(self.contents, f"certificate/{name}", dtype, math.prod(shape))

    def stream(self, name: str) -> Sequence:
        """An array of whole numbers, of any length."""
        return self.array(
            name, uint=record(self.members.get(name), "dtype:str shape:list")["shape"]
        )

    def check_counts(self, table: dict) -> None:
        """The intervals of the model contain confidence sets of all rows together, from counts.

        A row of 2 successors is one event, a row of J > 2 successors J events: a union bound.
        """
        confidence = to_fraction(table["confidence"])
        counts = self.array(table["member"], uint=[self.model.branch_start[-1]])
        need(0 < confidence < 1 and self.model.opponents["nature"], "counts are of intervals")
        ends = [*zip(self.model.branch_start, self.model.branch_start[1:])]
        sizes = [b - a for a, b in ends if b - a > 1]
        chance = (1 - confidence) / max(1, sum(1 if n == 2 else n for n in sizes))
        for r, (begin, end) in enumerate(ends):
            low, common, high = self.model.rows[r][1:]
            n = sum(counts[begin:end])
            need(n < 2**20, f"row {r} has over 2^20 samples")
            for k, a, b in zip(counts[begin:end], low, high or low):
                tests = (k, Fraction(a, common)), (n - k, 1 - Fraction(b, common))
                holds = all(x <= 0 or excludes(table["method"], i, n, x, chance) for i, x in tests)
                hold(holds or end - begin == 1, f"row {r}: the counts allow more than an interval")
        self.confidence = f", with confidence {table['confidence']}"
        fixed = "" if table["method"] == "anytime" else ", with sample sizes fixed in advance"
        self.trusted = f"the counts{fixed}, that rows have no other successors"
        self.trusted += f", and that {table['assumption']}"


# --- the conditions -------------------------------------------------------------------------------
class ClaimChecker:
    """The conditions of one claim, for all rows of the universal players and a fixed one of others.

    All inequalities have the form y >= r + p y: with y = x for upper bounds; y = -x for lower ones,
    with negative rewards; y = 1 - x for lower ones of formulas, as upper ones of the complement.
    """

    def __init__(self, file: CertificateFile, claim: dict) -> None:
        self.file, self.model, self.claim = file, file.model, record(claim, CLAIM)
        path, kind, states, side = file.path, file.kind, file.model.num_states, claim["side"]
        need(side in ("lower", "upper"), f"the side {side!r:.40} is neither lower nor upper")
        ours = "max" if side == "lower" else "min"
        self.is_negated = side == "lower" and kind == "formula"
        self.is_upper = side == "upper" or self.is_negated
        # The memory is that of the policy, or counts the steps that remain.
        sizes = [table["memory"] for table in (file.question, claim) if "memory" in table]
        sizes += [path["steps"] + 1] if "steps" in path else []
        hold(len(sizes) < 2, "two memories, or a memory and bounded steps, are not covered")
        self.counts, self.memory = "steps" in path, [*sizes, 1][0]
        axes = [file.automaton.num_states, *sizes] if file.automaton else sizes
        shape, self.width = [states, *axes], math.prod(axes)
        directions = file.direction["system"], file.direction["environment"], ""
        self.beliefs: Any = None
        if "beliefs" in claim:  # values of rows, then those of beliefs
            is_covered = "observations" in file.question and kind in ("until", "reward", "formula")
            is_covered &= not (sizes or any(self.model.opponents.values()) or directions[0] == ours)
            is_covered &= "policy" not in file.question and "policy" not in claim
            hold(is_covered, "beliefs are for optima of all policies that see observations")
            table, shape[0] = record(claim["beliefs"], BELIEFS), len(self.model.rows)
            pairs = iter(file.stream(table["vectors"]))
            self.beliefs = [{next(pairs): next(pairs) for _ in range(n)} for n in pairs]
        self.values = file.array(claim["values"], double=shape, rational=shape)
        if self.beliefs is not None:
            count = [len(self.beliefs)]
            more = file.array(table["values"], double=count, rational=count)
            self.values, self.covers = [*self.values, *more], file.stream(table["covers"])
        # A policy of the question knows states and memory alone, that of the claim nodes.
        axes = [self.memory] if "memory" in file.question else []
        rule, inner = (file.question, axes) if axes else (claim, shape[1:])
        self.next: Sequence = ()
        if "memory" in rule:
            self.next = file.array(rule["next"], uint=[states, *inner])
            self.block = math.prod(inner)
        need(max(self.next, default=0) < self.memory, "a memory state is out of range")
        self.is_ours = [directions[owner] == ours for owner in self.model.owner]
        self.is_our_nature, num_rows = file.direction["nature"] == ours, len(self.model.rows)
        name, same = "actions/choices/values", [0] * num_rows
        self.action = [*read_numbers(file.contents, name, "uint32", num_rows, same)]
        hold(not (self.is_our_nature and file.confidence), "counts prove what all intervals prove")
        fixing = {i: (claim, shape[1:]) for i in (0, 1) if directions[i] == ours}
        fixing |= {0: (file.question, axes)} if "policy" in file.question else {}
        # Of each owner: choices of nodes, or weights of rows at nodes, and nodes of a state.
        self.policy: dict[int, tuple] = {}
        for owner, (table, more) in fixing.items():
            if "policy" in table:
                rows, nodes = [num_rows, *more], [states, *more]
                numbers = file.array(table["policy"], uint=nodes, double=rows, rational=rows)
                self.policy[owner] = numbers, math.prod(more)
        if "observations" in file.question and (directions[0] == ours or 0 in self.policy):
            seen: Any = file.observation
            choices: dict[tuple, tuple] = {}
            hold(0 in self.policy, "a policy that sees observations is missing")
            starts = self.model.row_start
            for v in range(states * self.width):
                s = v // self.width
                chosen, weights = self.taken(v, 0)
                names = self.action[starts[s] : starts[s + 1]]
                choice = [r - starts[s] for r in chosen], weights, names, self.after(v)
                is_same = choices.setdefault((seen[s], v % self.memory), choice) == choice
                hold(is_same, f"state {s}: the policy depends on more than observations")
        # Values and rewards of branches as integers over one denominator.
        parts = self.model.reward(path["reward"]) if "reward" in path else []
        discount = to_fraction(path.get("discount", "1"))
        hold(0 <= discount < 1 or "discount" not in path, f"the discount is {discount}")
        self.is_signed = "discount" in path or any(min(part) < 0 for part in parts)
        self.infinite = {v for v, x in enumerate(self.values) if not -math.inf < x < math.inf}
        is_covered = "reward" in path and not self.is_signed and (kind == "reward" or self.is_upper)
        for v in self.infinite:
            is_known = is_covered and self.values[v] == math.inf
            hold(is_known, f"{self.place(v)}: the value {self.values[v]} is infinite or no number")
        finite = [0 if v in self.infinite else x for v, x in enumerate(self.values)]
        (x, *parts), self.one = to_integers(finite, *parts)
        sign, (ahead, scale) = 1 if self.is_upper else -1, discount.as_integer_ratio()
        self.y = [self.one - z for z in x] if self.is_negated else [sign * scale * z for z in x]
        self.following = self.y if ahead == scale else [sign * ahead * z for z in x]
        self.rewards = [sign * scale * sum(x) for x in zip(*parts)]
        # Above all sums of a finite value and rewards; it stands for infinity.
        self.infinity = sum(max(map(abs, z), default=0) for z in (self.y, self.rewards)) + self.one
        for v in self.infinite:
            self.y[v] = sign * self.infinity

    def place(self, v: int) -> str:
        if v < 0:
            return f"{self.claim['side']} bound: belief {-1 - v}"
        s, k = divmod(v, self.width)
        more = f", automaton and memory state {divmod(k, self.memory)}" if self.width > 1 else ""
        return f"{self.claim['side']} bound: state {s}{more}"

    def after(self, v: int) -> int:
        """The memory state after a node."""
        s, k = divmod(v, self.width)
        if self.next:
            return self.next[s * self.block + k % self.block]
        return k % self.memory - self.counts

    def taken(self, v: int, owner: int) -> tuple[Sequence, list]:
        """The rows of a node that its owner's policy takes, if it has one, and their weights."""
        (s, k), starts = divmod(v, self.width), self.model.row_start
        rows, (policy, block) = range(starts[s], starts[s + 1]), self.policy.get(owner, ((), 1))
        if not policy or len(rows) == 1:
            return rows, []
        if getattr(policy, "typecode", "d") != "d":
            choice = policy[s * block + k % block]
            hold(choice < len(rows), f"state {s}: the policy has no such choice")
            return (rows[choice],), []
        weights = [policy[r * block + k % block] for r in rows]
        is_known = all(0 <= x < math.inf for x in weights) and any(weights)
        hold(is_known, f"state {s}: the weights of a policy are negative, or no numbers")
        return [*compress(rows, weights)], [x for x in weights if x]

    def options(self, v: int) -> list[tuple]:
        """The options of a node: its rows, or that of the policy, or its mean of rows."""
        model, width, (s, k) = self.model, self.width, divmod(v, self.width)
        rows, weights = self.taken(v, model.owner[s])
        options, offset, automaton = [], 0, self.file.automaton
        if width > 1:
            q = k // self.memory
            q = automaton.edges[automaton.letter_of[s]][q][0] if automaton else q
            offset = q * self.memory + self.after(v)
        for r in rows:
            targets, low, total, high = model.rows[r]
            targets = [t * width + offset for t in targets] if width > 1 else targets
            rewards = self.rewards[model.branch_start[r] : model.branch_start[r + 1]]
            option = targets, low, total, high, rewards, ((0, len(low), total),) if high else ()
            if high and self.is_our_nature:
                option = targets, self.extreme(option)[1], total, None, rewards, ()
            options.append(option)
        if len(options) < 2 or not weights:
            return options
        # One option, whose parts have the mass of their weights.
        (weights,), _ = to_integers(weights)
        common = math.lcm(*(option[2] for option in options))
        mixed: tuple = [], [], sum(weights) * common, [] if options[0][3] else None, [], []
        for (targets, low, total, high, rewards, _), weight in zip(options, weights):
            scale, begin = weight * (common // total), len(mixed[0])
            mixed[0].extend(targets)
            mixed[1].extend([n * scale for n in low])
            mixed[4].extend(rewards)
            if high:
                mixed[3].extend([n * scale for n in high])
                mixed[5].append((begin, len(mixed[0]), total * scale))
        return [mixed]

    def extreme(self, option: tuple) -> tuple[list, list]:
        """Values of successors with rewards, and numerators of the worst (or our best) distribution.

        What is missing to 1 goes to successors in the order of values, and equal values share it.
        """
        targets, low, _, high, rewards, parts = option
        values = [self.following[t] for t in targets]
        if rewards:
            values = list(map(add, values, rewards))
        if high:
            low, value_of = low[:], values.__getitem__
        for begin, end, mass in parts:
            missing = mass - sum(low[begin:end])
            order = sorted(range(begin, end), key=value_of, reverse=not self.is_our_nature)
            for _, group in groupby(order, value_of):
                if not missing:
                    break
                ends = [(i, high[i] - low[i]) for i in group]
                room = sum([n for _, n in ends])
                more = min(room, missing)
                missing -= more
                for i, n in ends:
                    low[i] += n if more == room else more if n == room else Fraction(more * n, room)
        return values, low

    def is_inductive(self, v: int, options: list[tuple]) -> bool:
        """True if y >= r + p y: for some row of an existential player, or for each row."""
        is_some = len(options) > 1 and self.is_ours[v // self.width]
        for option in options:
            values, mass = self.extreme(option)
            holds = self.y[v] * option[2] >= sum(map(mul, mass, values))
            if self.infinite and any(n and abs(y) >= self.infinity for n, y in zip(mass, values)):
                holds = not self.is_upper
            if holds == is_some:
                return is_some
        return not is_some

    def seen(self, v: int) -> int:
        return self.file.observation[v // self.width]

    def row(self, v: int, k: int) -> int:
        """The place of a node's row among the values of rows."""
        return (self.model.row_start[v // self.width] + k) * self.width + v % self.width

    def informed(self, mass: dict) -> int:
        """A bound for a measure on nodes of one observation: that of its best first row."""
        count = len(self.graph[next(iter(mass))])
        return max(sum([n * self.y[self.row(v, k)] for v, n in mass.items()]) for k in range(count))

    def moved(self, mass: dict, k: int) -> tuple[Any, dict, int]:
        """The reward of row k of each node, the measure after it, and the denominator of both."""
        options = [self.graph[v][k] for v in mass]
        common, gain = math.lcm(*[option[2] for option in options]), 0
        after: dict = {}
        for n, (targets, low, total, _, rewards, _) in zip(mass.values(), options):
            scale = n * (common // total)
            gain += scale * sum(map(mul, low, rewards))
            for t, p in zip(targets, low):
                if p:
                    after[t] = after.get(t, 0) + scale * p
        return gain, after, common

    def parts(self, mass: dict) -> tuple[int, list[dict]]:
        """The value of what has ended, and the rest by observations."""
        parts: dict = {}
        ended = 0
        for v, n in mass.items():
            if v in self.ends:
                ended += n * self.ends[v]
            else:
                parts.setdefault(self.seen(v), {})[v] = n
        return ended, [parts[o] for o in sorted(parts)]

    def taken_out(self, rest: dict, j: int) -> tuple[int, int, dict]:
        """The largest n/d so that n/d times belief j is within a measure, and d times the rest."""
        belief, n, d = self.beliefs[j], 1, 0
        for v, m in belief.items():
            if rest.get(v, 0) * d < n * m:
                n, d = rest.get(v, 0), m
        common = math.gcd(n, d)
        n, d = n // common, d // common
        rest = {v: x * d - n * belief.get(v, 0) for v, x in rest.items()}
        return n, d, {v: x for v, x in rest.items() if x}

    def bound(self, mass: dict, covers: Iterator | None = None) -> tuple[Any, list]:
        """A bound for a measure on nodes, and the nodes and beliefs of which it is made.

        For each observation it is that of the best first row, or of a cover by stored beliefs.
        """
        total: Any
        total, parts = self.parts(mass)
        used: list = [None] * (len(mass) > sum(map(len, parts)))
        for rest in parts:
            best, terms = self.informed(rest), [*rest]
            cover = [next(covers) for _ in range(next(covers))] if covers else []
            need(len(cover) <= 64, "a cover has over 64 beliefs")
            value, scale, taken = 0, 1, []
            for j in cover:
                n, d, rest = self.taken_out(rest, j)
                value, scale = value * d + n * self.worth[j], scale * d
                taken += [-1 - j] * (n > 0)
            value += self.informed(rest) if rest and cover else 0
            if cover and value < best * scale:
                total, best, terms = total + Fraction(value, scale), 0, [*taken, *rest]
            total, used = total + best, used + terms
        return total, used

    def check_beliefs(self, graph: dict, ends: dict, starts: list[dict]) -> list[Fraction]:
        """Checks the inequalities of rows and of stored beliefs; returns bounds of some measures."""
        hold(
            not (self.infinite or self.is_signed), "values with beliefs are finite and of one sign"
        )
        self.graph, self.ends = graph, ends
        top, floor = (self.one, 0) if self.is_upper else (0, -math.inf)
        is_reward = self.file.kind == "reward"
        nodes = {v: {v: 1} for v in graph if v not in ends}
        actions: dict = {}
        for v in nodes:
            names = self.action[self.row(v, 0) // self.width :][: len(graph[v])]
            is_same = actions.setdefault(self.seen(v), names) == names
            hold(is_same, f"{self.place(v)}: a state of equal observation has other actions")
        for j, belief in enumerate(self.beliefs):
            fits = belief and all(v in nodes and n for v, n in belief.items())
            hold(fits and len(self.parts(belief)[1]) == 1, f"belief {j} has not one observation")
        y = self.y[len(self.y) - len(self.beliefs) :]
        self.worth = [sum(belief.values()) * x for belief, x in zip(self.beliefs, y)]
        region: dict = {}
        covers = iter(self.covers)
        bounds = [self.bound(start, covers)[0] for start in starts]
        nodes |= {-1 - j: belief for j, belief in enumerate(self.beliefs)}
        for v, mass in nodes.items():
            region[v] = []
            for k in range(len(graph[next(iter(mass))])):
                gain, moved, common = self.moved(mass, k)
                least, used = self.bound(moved, covers if v < 0 else None)
                x = self.y[self.row(v, k)] if v >= 0 else y[-1 - v]
                holds = x >= floor and x * sum(mass.values()) * common >= gain + least
                why = f"{self.place(v)}, choice {k}: the value does not follow from its successors"
                hold(holds or (x >= top and not is_reward), why)
                if x < top or is_reward:
                    region[v].append((used, [1] * len(used), len(used), None, (), ()))
        hold(next(covers, None) is None, "there are more covers than successors of beliefs")
        if self.file.kind != "formula" and self.is_upper == is_reward:
            for v in staying(region):
                raise Refusal(f"{self.place(v)}: paths may stay forever, and miss the target")
        means = [Fraction(x, sum(start.values()) * self.one) for x, start in zip(bounds, starts)]
        return [1 - x if self.is_negated else x if self.is_upper else -x for x in means]

    def explored(self, is_hidden: bool) -> tuple[dict, dict, list[int]]:
        """The options of all nodes, the values y of those where the question ends, the initial ones."""
        path, width = self.file.path, self.width
        target = self.file.states(path.get("target", ["false"]))
        stay = self.file.states(path.get("stay", ["true"]))

        def expand(v: int) -> list[tuple]:
            is_final = target[v // width] or not stay[v // width]
            return [] if is_final or (self.counts and not v % self.memory) else self.options(v)

        automaton, accepted = self.file.automaton, set()
        start = automaton.initial * self.memory if automaton else (self.memory - 1) * self.counts
        initial = [s * width + start for s, x in enumerate(self.model.initial) if x]
        graph = explore(initial, expand, itemgetter(0))
        if automaton:
            edges = [automaton.edges[i] for i in automaton.letter_of]
            priority = {v: edges[v // width][v % width // self.memory][1] for v in graph}
            accepted = accepting(graph, priority, self.is_negated, [], is_hidden)
        final = [v for v, options in graph.items() if not options or v in accepted]
        is_one = (v in accepted or ("reward" not in path and target[v // width]) for v in final)
        one = self.one if self.is_upper else -self.one
        return graph, {v: one * x for v, x in zip(final, is_one)}, initial

    def check(self) -> tuple[int, str]:
        """Checks the claim; returns the number of nodes, and what the claim says."""
        path, kind, width, y = self.file.path, self.file.kind, self.width, self.y
        graph, ends, initial = self.explored(self.beliefs is not None)
        # The inequality is needed below `top`, and values are not below `floor`.
        top = self.infinity if "reward" in path else self.one
        top, floor = (top, 0) if self.is_upper else (0, -self.infinity)
        if self.is_signed:
            top, floor = self.infinity, -self.infinity
        for v, options in graph.items() if self.beliefs is None else ():
            if v in ends:
                holds = y[v] >= ends[v]
            else:
                holds = y[v] >= top or v in self.infinite
                holds = holds or (y[v] >= floor and self.is_inductive(v, options))
            if not holds:
                raise Refusal(f"{self.place(v)}: the value does not follow from its successors")
        # Where paths must not stay forever.
        nodes, region = {v: options for v, options in graph.items() if options}, {}
        stops = "steps" in path or "discount" in path or self.beliefs is not None
        hold(stops or kind != "total" or not self.is_signed, "totals of both signs are not covered")
        if self.beliefs is None and kind == "reward" and (self.is_upper or self.is_signed):
            region = {v: options for v, options in nodes.items() if v not in self.infinite}
        elif kind in ("until", "total") and not self.is_upper and not stops:
            # Options that earn a reward, whatever nature does, have an infinite total if they recur.
            for v in [v for v in nodes if y[v] < 0]:
                idle = [o for o in nodes[v] if not any(map(mul, o[1], o[4]))]
                region[v] = [o for o in idle if not o[4] or 0 in o[4]]
        for v in staying(region):
            raise Refusal(f"{self.place(v)}: paths may stay forever, and miss the target")
        if self.infinite and not self.is_upper:
            final = graph.keys() - nodes
            loops = {v: [((v,), (1,), 1, None, (), ())] for v in final}
            for v in recurring({**nodes, **loops}, [final]).keys() & self.infinite:
                raise Refusal(f"{self.place(v)}: the target can be reached surely, no infinity")
        # The bound in the initial states.
        text, is_lower = self.claim["bound"], self.claim["side"] == "lower"
        bound = math.inf if text == "inf" else to_fraction(text)
        relation, worst = (ge, min) if is_lower else (le, max)
        v = worst(initial, key=self.values.__getitem__) if self.beliefs is None else initial[0]
        value, weights, starts = self.values[v], self.file.weights, [{v: 1} for v in initial]
        if weights:
            used = [s for s, w in enumerate(weights) if w]
            fits = used and all(weights[s] > 0 and self.model.initial[s] for s in used)
            need(fits, "the weights of initial states are no distribution of them")
            numbers = to_integers([weights[v // width] for v in initial])[0][0]
            starts = [{v: n for v, n in zip(initial, numbers) if n}]
        if self.beliefs is not None:
            value = worst(self.check_beliefs(graph, ends, starts))
        elif weights:
            is_infinite = any(self.values[v] == math.inf for v in starts[0])
            pairs = [] if is_infinite else starts[0].items()
            mean = sum(Fraction(self.values[v]) * n for v, n in pairs) / sum(numbers)
            value = math.inf if is_infinite else mean
        hold(relation(value, bound), f"{self.place(v)}: {value!s:.40} is beyond {text:.40}")
        claimed = f"{self.file.question['text']} is {'>=' if is_lower else '<='} {text}"
        place = "" if weights else " in every initial state"
        return len(graph), f"{claimed}{place}{self.file.confidence}"


def verdict(path: str, limit: int = 2**30) -> tuple[int, list[str]]:
    """Checks a file of at most `limit` bytes; returns the exit status and the lines to print."""
    status, lines = 0, []
    gc.disable()  # nothing here is cyclic, and there are millions of tuples
    try:
        file = CertificateFile(read_archive(path, limit))
        for claim in file.claims:
            num_nodes, text = ClaimChecker(file, claim).check()
            lines += [f"claimed: {text}", f"checked: {num_nodes} nodes of the claim's graph"]
        trust = "; ".join(x for x in (file.trusted, file.unproven) if x) or "nothing else"
        parts = ["model", *(x for x in ("policy", "observations") if x in file.question)]
        meant = "is the one meant" if len(parts) == 1 else "are those meant"
        lines += [f"on trust: that the {' and '.join(parts)} {meant}; {trust}"]
        status = 3 if file.unproven else 0
        lines += ["ACCEPTED, given the automaton" if file.unproven else "ACCEPTED"]
    except Refusal as why:
        status, lines = 1, [f"REFUSED: {why}"]
    except Exception as why:  # no error of any kind is an acceptance
        status, lines = 2, [f"not a certificate: {type(why).__name__}: {why}"]
    gc.enable()
    most = 2000 if status else None  # a claim without its end is another claim
    return status, ["".join(c if c.isprintable() else "?" for c in line[:most]) for line in lines]


def main(arguments: Sequence[str] | None = None) -> int:
    """Checks a file and prints the outcome; returns the exit status."""
    parser = argparse.ArgumentParser(description="Check a certificate by exact arithmetic.")
    parser.add_argument("file")
    parser.add_argument("--limit", type=int, default=2**30, help="most bytes of the archive")
    options = parser.parse_args(arguments)
    status, lines = verdict(options.file, options.limit)
    print(*lines, sep="\n")
    return status


if __name__ == "__main__":
    sys.exit(main())
