"""Checks a certificate by exact arithmetic, without jaxltl: ``python checker.py FILE``.

A certificate is a model in the UMB format with further members: ``certificate/index.json`` (the
question, the claims, the shapes of arrays) and arrays (bounds, policies, an automaton). This file
shares no code with the solvers. It prints ACCEPTED (exit status 0), REFUSED and why (1), or why the
file is no certificate (2). docs/certificates.md derives every condition.

S states, R rows (choices), Q automaton states, M memory states. A node is a state with an automaton
state and a memory state, numbered (s Q + q) M + m; `width` is Q M.
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
from operator import le, mul
from typing import Any, TypeVar

T = TypeVar("T")
Ways = list  # pairs: formulas for the next step, and bits of postponed untils
Graph = dict  # by node: its options, or its successors
LARGEST_TABLEAU = 20_000  # states of the product that compares automaton and formula
NUMBERS = "exact values, normalised rows"
OTHER = {"max": "min", "min": "max"}
PATHS = {
    "until": ("target", "stay"),
    "within": ("target", "stay", "steps"),
    "reward": ("reward", "target"),
    "total": ("reward",),
    "cumulative": ("reward", "steps"),
    "discounted": ("reward", "discount"),
    "formula": ("formula", "automaton"),
}


class Unreadable(Exception):
    """The file is no certificate."""


class Refusal(Exception):
    """A condition does not hold."""


def need(condition: object, why: str, error: type[Exception] = Unreadable) -> None:
    if not condition:
        raise error(why)


hold = functools.partial(need, error=Refusal)


# --- reading ----------------------------------------------------------------------------------


def read_archive(path: str, limit: int) -> dict[str, bytes]:
    """Contents of the regular files of a tar archive, plain or gzipped, by name."""
    contents: dict[str, bytes] = {}
    with open(path, "rb") as plain:
        is_gzip = plain.read(2) == b"\x1f\x8b"
        plain.seek(0)
        file: Any = gzip.GzipFile(fileobj=plain) if is_gzip else plain
        pieces, size = [], 0
        while piece := file.read(2**20):
            pieces.append(piece)
            size += len(piece)
            need(size <= limit, f"the archive has more than {limit} bytes; see --limit")
    data = b"".join(pieces)
    with tarfile.open(fileobj=io.BytesIO(data), mode="r:") as archive:
        for info in archive:
            if not info.isdir():
                name, end = info.name.lstrip("./"), info.offset_data + info.size
                is_whole = info.isreg() and not info.issparse() and end <= len(data)
                need(is_whole, f"{name!r:.80} is cut off or no file")
                need(name not in contents, f"two members are named {name!r:.80}")
                contents[name] = data[info.offset_data : end]
    return contents


def parse_json(contents: dict[str, bytes], name: str) -> dict:
    """The object of a member in JSON, without repeated keys; numbers with a point remain text."""

    def pairs(items: list[tuple[str, object]]) -> dict:
        need(len({key for key, _ in items}) == len(items), f"{name}: a key is given twice")
        return dict(items)

    def whole(text: str) -> int:
        need(len(text) <= 20, f"{name}: a number has more than 20 digits")
        return int(text)

    need(0 < len(contents.get(name, b"")) < 2**24, f"{name} is missing or has over 16 MiB")
    text = contents[name].decode()
    data = json.loads(text, object_pairs_hook=pairs, parse_int=whole, parse_float=str)
    need(isinstance(data, dict), f"{name} is no object")
    return data


def field(table: dict, key: str, kind: type[T], default: T | None = None) -> T:
    """The value of a key, of this type."""
    value: Any = table.get(key, default)
    is_negative = isinstance(value, int) and value < 0
    need(type(value) is kind and not is_negative, f"{key!r:.80} is missing or wrong")
    return value


def only(table: dict, *keys: str) -> dict:
    """The table itself, without other keys, which could change its meaning."""
    need(isinstance(table, dict), "an object of the index is none")
    need(table.keys() <= {*keys}, f"{sorted(table.keys() - {*keys})[:1]} is unknown to version 1")
    return table


def to_fraction(text: str) -> Fraction:
    number = r"-?\d{1,4000}(\.\d{1,4000})?(e[+-]?\d{1,3}|/0*[1-9]\d{0,3999})?"
    need(re.fullmatch(number, text, re.ASCII), f"{text!r:.40} is no number such as 0.25 or 1/4")
    return Fraction(text)


def read_integers(contents: dict[str, bytes], name: str, code: str, count: int) -> array:
    """A member of little-endian numbers with a type code of the module array."""
    values, data = array(code), contents.get(name, b"")
    size = count * values.itemsize
    need(len(data) == size, f"{name:.80} has {len(data)} bytes; expected {size}")
    values.frombytes(data)
    if sys.byteorder == "big":
        values.byteswap()
    return values


def read_reals(
    contents: dict[str, bytes], name: str, kind: str, bits: int, count: int, infinite: bool = False
) -> Sequence:
    """Finite doubles, or rationals; doubles are read and never computed with."""
    if kind == "double" and bits == 64:
        values = read_integers(contents, name, "d", count)
        if not all(map(math.isfinite, values)):
            for i, x in enumerate(values):
                hold(math.isfinite(x) or (infinite and x > 0), f"{name}: entry {i} is {x}")
        return values
    data, half = contents.get(name, b""), bits // 16
    is_rational = kind == "rational" and bits in range(128, 2**16, 128)
    need(is_rational and len(data) == 2 * half * count, f"{name:.80} has not {count} {kind:.40}s")
    parts = [data[i : i + half] for i in range(0, len(data), half)]
    above = [int.from_bytes(x, "little", signed=True) for x in parts[::2]]
    below = [int.from_bytes(x, "little") for x in parts[1::2]]
    hold(all(below), f"{name}: a denominator is 0")
    return list(map(Fraction, above, below))


def to_integers(*lists: Iterable) -> tuple[list[list], int]:
    """Lists of numbers as integers over one common denominator, or as fractions if it is huge."""
    ratios = [[x.as_integer_ratio() for x in values] for values in lists]
    common = 1
    for d in {d for values in ratios for _, d in values}:
        common = common * d // math.gcd(common, d)
        if common.bit_length() > 4096:
            return [[Fraction(n, d) for n, d in values] for values in ratios], 1
    return [[n * (common // d) for n, d in values] for values in ratios], common


class UmbModel:
    """A model of a UMB archive."""

    def __init__(self, contents: dict[str, bytes]) -> None:
        self.contents, index = contents, parse_json(contents, "index.json")
        system = field(index, "transition-system", dict)
        sizes = [field(system, f"#{x}", int) for x in ("states", "choices", "branches", "players")]
        self.num_states, self.num_rows, self.num_branches, self.num_players = sizes
        version = field(index, "format-version", int), field(system, "time", str, "discrete")
        need(version == (1, "discrete"), f"a model of version and time {version!s:.80}")
        need(not field(system, "#observations", int, 0), "observations belong to the question")
        self.annotations = field(index, "annotations", dict, {})
        self.target = read_integers(contents, "branch-to-target.bin", "Q", self.num_branches)
        sizes_fit = 0 < self.num_states <= self.num_rows <= self.num_branches
        need(sizes_fit and max(self.target) < self.num_states, "a state or choice has no successor")
        self.row_start = self._starts("state-to-choices.bin", self.num_states, self.num_rows)
        self.branch_start = self._starts("choice-to-branches.bin", self.num_rows, self.num_branches)
        chance = field(system, "branch-probability-type", dict)
        self.lower, self.upper = self._reals("branch-to-probability.bin", chance, self.num_branches)
        hold(min(self.lower) >= 0, f"a probability is {min(self.lower)}")
        counts = {
            "state-to-player.bin": self.num_states,
            "actions/choices/values.bin": self.num_rows,
        }
        self.owner, self.action = (
            read_integers(contents, x, "I", n) if x in contents else array("I", [0]) * n
            for x, n in counts.items()
        )
        self.is_choice = [b - a > 1 for a, b in zip(self.row_start, self.row_start[1:])]
        most = min(2, self.num_players)
        wrong = [s for s, x in enumerate(self.owner) if self.is_choice[s] and x >= most]
        need(not wrong, f"state {wrong[:1]} has several choices, but neither player owns it")
        self.initial = [True] * self.num_states
        if "state-is-initial.bin" in contents:
            self.initial = self._bits("state-is-initial.bin")
        need(True in self.initial, "no state is initial")
        self._rows: dict[object, tuple[list, int, list | None]] = {}

    def _starts(self, name: str, count: int, total: int) -> array:
        if name not in self.contents and count == total:
            return array("Q", range(count + 1))
        starts = read_integers(self.contents, name, "Q", count + 1)
        increases = not any(map(le, starts[1:], starts))
        need(increases and (starts[0], starts[-1]) == (0, total), f"{name} does not increase")
        return starts

    def _bits(self, name: str) -> list[bool]:
        words = read_integers(self.contents, name, "Q", -(-self.num_states // 64))
        return [bool(words[s >> 6] >> (s & 63) & 1) for s in range(self.num_states)]

    def _reals(self, name: str, kind: dict, count: int) -> tuple[Sequence, Sequence | None]:
        """Numbers, or lower and upper ends of intervals."""
        word = field(kind, "type", str)
        is_interval = word.endswith("-interval")
        word = word[:-9] if is_interval else word
        usual = (64 if word == "double" else 128) << is_interval
        bits = field(kind, "size", int, usual) >> is_interval
        values = read_reals(self.contents, name, word, bits, count << is_interval)
        return (values[::2], values[1::2]) if is_interval else (values, None)

    def _annotation(self, group: str, name: str) -> list[tuple[str, dict]]:
        """Folder and entry of the annotations with a name."""
        entries = {
            k: x for k, x in field(self.annotations, group, dict, {}).items() if type(x) is dict
        }
        names = {k: x.get("alias", k) for k, x in entries.items()}
        return [(f"annotations/{group}/{k}", entries[k]) for k in names if names[k] == name]

    def label(self, name: str) -> list[bool]:
        """The states with a label; `init` is the initial ones where no label has this name."""
        places = self._annotation("aps", name) + self._annotation("other-aps", name)
        if not places and name == "init":
            return self.initial
        need(len(places) == 1, f"the model has {len(places)} labels {name!r:.80}")
        return self._bits(places[0][0] + "/states/values.bin")

    def reward(self, name: str) -> list[Sequence]:
        """Rewards of states, rows and branches; an empty list stands for zeros."""
        places = self._annotation("rewards", name)
        need(len(places) == 1, f"the model has {len(places)} rewards {name!r:.80}")
        folder, entry = places[0]
        kind, applies = field(entry, "type", dict), field(entry, "applies-to", list)
        sizes = {"states": self.num_states, "choices": self.num_rows, "branches": self.num_branches}
        parts: list[Sequence] = []
        for part, count in sizes.items():
            member = f"{folder}/{part}/values.bin"
            low, high = self._reals(member, kind, count) if part in applies else ([], None)
            need(high is None or list(low) == list(high), f"the reward {name!r:.80} has intervals")
            parts.append(low)
        return parts

    def row(self, r: int) -> tuple[list, int, list | None]:
        """Numerators of probabilities, their denominator, and upper ends if they are intervals.

        Probabilities are n_t / sum(n). Upper ends are lowered to what the other branches leave.
        """
        begin, end = self.branch_start[r], self.branch_start[r + 1]
        lower, upper = self.lower[begin:end], None
        key: object = lower.tobytes() if isinstance(lower, array) else tuple(lower)
        if self.upper is not None:
            upper = self.upper[begin:end]
            key = key, tuple(upper)
        if key in self._rows:
            return self._rows[key]
        if isinstance(lower, array) and upper is None:  # denominators are powers of 2
            ratios = [x.as_integer_ratio() for x in lower]
            common = max([d for _, d in ratios])
            low = [n * (common // d) for n, d in ratios]
        else:
            (low, high), common = to_integers(lower, upper or ())
        row: tuple[list, int, list | None] = low, sum(low), None
        if upper is not None:
            slack = common - sum(low)
            fits = slack >= 0 and sum(high) >= common and not any(a > b for a, b in zip(low, high))
            hold(fits, f"row {r}: no distribution lies within its intervals")
            row = low, common, [min(b, a + slack) for a, b in zip(low, high)]
        if not row[1]:
            raise Refusal(f"row {r}: all probabilities are 0")
        if len(self._rows) > 2**16:
            self._rows.clear()
        self._rows[key] = row
        return row


# --- formulas and automata --------------------------------------------------------------------


class Formulas:
    """Formulas of linear temporal logic in negation normal form, each stored once by a number."""

    _TOKEN = re.compile(r'"(?:[^"\\]|\\.)*"|<=>|=>|<->|->|[A-Za-z0-9_][\w.]*|\S')
    _BINARY = frozenset(["&", "|", "->", "=>", "<->", "<=>", "xor", "U", "R", "W", "M"])

    def __init__(self) -> None:
        self.nodes: list[tuple] = []
        self.number: dict[tuple, int] = {}
        self.expanded: dict[tuple, Ways] = {}
        self.names: set[str] = set()  # of the formula that was parsed last

    def make(self, *node: object) -> int:
        if self.number.setdefault(node, len(self.nodes)) == len(self.nodes):
            self.nodes.append(node)
        return self.number[node]

    def parse(self, text: str, columns: Sequence[str] | None = None) -> tuple[int, int]:
        """The numbers of a formula and of its negation; `columns` names numbers in HOA labels.

        Tools differ in the precedence of operators. Where it matters, parentheses are required.
        """
        tokens = [*self._TOKEN.findall(text), ""][::-1]
        need(len(tokens) < 2000, "a formula has 2000 tokens")
        self.names = set()
        true = self.make("true"), self.make("false")

        def both(op: str, f: tuple, g: tuple) -> tuple[int, int]:
            dual = {"and": "or", "or": "and", "U": "R", "R": "U"}[op]
            return self.make(op, f[0], g[0]), self.make(dual, f[1], g[1])

        def unary() -> tuple[tuple[int, int], bool]:
            """A formula, and if it begins with a temporal operator."""
            token = tokens.pop()
            if token == "(":
                f = group()
                need(tokens.pop() == ")", f"{text!r:.80}: expected )")
                return f, False
            if token in ("!", "X", "F", "G"):
                f, is_temporal = unary()
                if token == "!":
                    return (f[1], f[0]), is_temporal
                if token == "X":
                    return (self.make("X", f[0]), self.make("X", f[1])), True
                return both("U", true, f) if token == "F" else both("R", true[::-1], f), True
            if token in ("true", "false") or (columns is not None and token in ("t", "f")):
                return true if token[0] == "t" else (true[1], true[0]), False
            is_number = columns is not None and re.fullmatch(r"\d{1,6}", token)
            if is_number and int(token) < len(columns or ()):
                name = (columns or ())[int(token)]
            else:
                bare = re.fullmatch(r"(?![FGX](?!\d))[A-Za-z_][\w.]*", token)
                is_name = token[:1] == '"' or (bare and columns is None)
                reserved = token in self._BINARY or token.lower() in ("true", "false", "xor")
                need(is_name and not reserved, f"{text!r:.80}: {token!r:.20} is no name")
                name = re.sub(r"\\(.)", r"\1", token[1:-1]) if token[0] == '"' else token
            self.names.add(name)
            return (self.make("ap", name, True), self.make("ap", name, False)), False

        def group() -> tuple[int, int]:
            f, is_temporal = unary()
            terms: list[tuple[int, int]] = [f]  # of a disjunction
            operators: set[str] = set()
            while tokens[-1] in self._BINARY:
                op = tokens.pop().replace("=", "-")
                g, is_also = unary()
                is_temporal |= is_also
                is_clear = not is_temporal and (not operators or {op, *operators} <= {"&", "|"})
                need(is_clear, f"{text!r:.80}: add parentheses at {op!r}")
                operators.add(op)
                if op == "|":
                    terms.append(g)
                elif op == "->":
                    terms = [both("or", f[::-1], g)]
                elif op in ("xor", "<->"):
                    same = both("or", both("and", f, g), both("and", f[::-1], g[::-1]))
                    terms = [(same[1], same[0]) if op == "xor" else same]
                elif op in ("W", "M"):
                    terms = [
                        both("R", g, both("or", f, g))
                        if op == "W"
                        else both("U", g, both("and", f, g))
                    ]
                else:
                    terms[-1] = both("and" if op == "&" else op, terms[-1], g)
            return functools.reduce(functools.partial(both, "or"), terms)

        f = group()
        need(tokens == [""], f"{text!r:.80}: {tokens[-1]!r:.20} is out of place")
        return f

    def holds(self, f: int, letter: frozenset[str]) -> bool:
        """True if a formula without temporal operators holds for a set of propositions."""
        op, *parts = self.nodes[f]
        need(op not in ("U", "R", "X"), "a temporal operator where a set of states is expected")
        if op == "ap":
            return (parts[0] in letter) == parts[1]
        return (all if op in ("and", "true") else any)(self.holds(x, letter) for x in parts)

    def expand(self, f: int, letter: frozenset[str]) -> Ways:
        """Ways to satisfy a formula: the formulas left for the next step, and postponed untils."""
        if (f, letter) in self.expanded:
            return self.expanded[f, letter]
        op, *parts = self.nodes[f]
        again = frozenset([f])
        if op == "X":
            ways: Ways = [(frozenset(parts), 0)]
        elif op in ("and", "or"):
            first, second = (self.expand(x, letter) for x in parts)
            ways = first + second if op == "or" else self.joint([first, second])
        elif op == "U":
            ways = self.joint([self.expand(parts[0], letter), [(again, 1 << f)]])
            ways += self.expand(parts[1], letter)
        elif op == "R":
            either = [*self.expand(parts[0], letter), (again, 0)]
            ways = self.joint([self.expand(parts[1], letter), either])
        else:
            ways = [(frozenset(), 0)] if self.holds(f, letter) else []
        self.expanded[f, letter] = ways
        return ways

    def joint(self, choices: Iterable[Ways]) -> Ways:
        """Ways to satisfy several formulas together."""
        ways: Ways = [(frozenset(), 0)]
        for more in choices:
            if len(ways) * len(more) > LARGEST_TABLEAU:
                raise OverflowError
            ways = list(dict.fromkeys((a | c, b | d) for a, b in ways for c, d in more))
        return ways


class HoaAutomaton:
    """A deterministic automaton in the HOA format.

    It accepts a word if the least priority that occurs infinitely often is even.
    """

    _STATE = re.compile(r'\s*State:\s*(\d{1,9})\s*(?:"(?:[^"\\]|\\.)*")?\s*(\{[\d\s]*\})?\s*')
    _EDGE = re.compile(r"\s*\[([^\]]*)\]\s*(\d{1,9})\s*(\{[\d\s]*\})?\s*")

    def __init__(self, text: str) -> None:
        parts = re.split(r"--(BODY|END)--", text)
        is_whole = parts[1::2] == ["BODY", "END"] and not parts[4].strip()
        need(
            is_whole and text.startswith("HOA: v1"),
            "the automaton is not one text in the HOA format",
        )
        quoted = r'"(?:[^"\\]|\\.)*"'
        lines = {"Start": r"(\d{1,6})", "States": r"(\d{1,6})", "AP": rf"\d+((?: {quoted})*)"}
        lines["Acceptance"] = r"\d+ (.+)"
        found_lines = [re.findall(rf"(?m)^{k}: {x}\s*$", parts[0]) for k, x in lines.items()]
        is_unique = all(len(x) == 1 for x in found_lines)
        need(is_unique, f"the automaton needs one line each of {', '.join(lines)}")
        start, states, names, condition = (x[0] for x in found_lines)
        self.initial, self.num_states, self.body = int(start), int(states), parts[2].rstrip()
        need(self.initial < self.num_states, "the automaton has no initial state")
        self.columns = [re.sub(r"\\(.)", r"\1", x[1:-1]) for x in re.findall(quoted, names)]
        # A chain such as Inf(0) | (Fin(1) & Inf(2)): the first set that recurs decides.
        condition, chain = condition.replace(" ", ""), ""
        atoms = re.findall(r"(Inf|Fin)\((\d{1,6})\)", condition)
        for kind, number in reversed(atoms):
            rest = f"({chain})" if chain.count("(") > 1 else chain
            chain = f"{kind}({number})" + (rest and ("|" if kind == "Inf" else "&") + rest)
        need(condition in (chain, "t", "f"), f"{condition!r:.80} is no parity acceptance")
        self.priority_of = {x: 2 * i + (k == "Fin") for i, (k, x) in [*enumerate(atoms)][::-1]}
        accepts = atoms[-1][0] == "Fin" if atoms else condition == "t"
        self.default = 2 * len(atoms) + (not accepts)

    def read_edges(self, formulas: Formulas, letters: Sequence[frozenset[str]]) -> None:
        """Reads the edges, of which each state has one for each letter."""
        self.letters = letters
        self.edges: list[dict[int, tuple[int, int]]] = [{} for _ in letters]
        labels: dict[str, list[int]] = {}
        position, q, marks = 0, -1, ""
        while position < len(self.body):
            if match := self._STATE.match(self.body, position):
                q, marks = int(match[1]), match[2] or ""
            else:
                match = self._EDGE.match(self.body, position)
                if match is None or q < 0:
                    raise Unreadable(f"the automaton is wrong at {self.body[position:][:40]!r}")
                label, successor = match[1], int(match[2])
                if label not in labels:
                    f = formulas.parse(label, self.columns)[0]
                    labels[label] = [i for i, x in enumerate(letters) if formulas.holds(f, x)]
                sets = re.findall(r"\d+", marks + (match[3] or ""))
                priority = min(
                    (self.priority_of.get(x, self.default) for x in sets), default=self.default
                )
                edge = successor, priority
                need(successor < self.num_states, f"automaton state {successor} does not exist")
                for i in labels[label]:
                    unique = self.edges[i].setdefault(q, edge) == edge
                    hold(unique, f"automaton state {q} has two edges for one letter")
            position = match.end()

    def follow(self, letter: int, q: int) -> tuple[int, int]:
        """Successor and priority."""
        if q not in self.edges[letter]:
            raise Refusal(f"automaton state {q} has no edge for {sorted(self.letters[letter])}")
        return self.edges[letter][q]

    def meets(self, parity: int, formulas: Formulas, f: int) -> bool:
        """True if some word satisfies a formula and has a run whose least priority has the parity.

        Emptiness of the product with the formula's tableau, which is a generalised Buchi automaton:
        each until is not postponed infinitely often. OverflowError if the product is too large.
        """
        start = self.initial, frozenset([f])
        graph: dict[tuple, list[tuple[tuple, int, int]]] = {start: []}
        pending, size = [start], 0
        while pending:
            node = pending.pop()
            for i, letter in enumerate(self.letters):
                ways = formulas.joint([formulas.expand(x, letter) for x in node[1]])
                successor, priority = self.follow(i, node[0]) if ways else (0, 0)
                size += len(ways) + 1
                for rest, postponed in ways:
                    other = successor, rest
                    graph[node].append((other, priority, postponed))
                    if other not in graph:
                        graph[other] = []
                        pending.append(other)
            if len(graph) > LARGEST_TABLEAU or size > 20 * LARGEST_TABLEAU:
                raise OverflowError
        for least in {p for out in graph.values() for _, p, _ in out if p % 2 == parity}:
            part = {v: [w for w, p, _ in out if p >= least] for v, out in graph.items()}
            for component in map(set, components(part)):
                steps = [
                    x for v in component for x in graph[v] if x[0] in component and x[1] >= least
                ]
                always = -1
                for _, _, postponed in steps:
                    always &= postponed
                if not always and any(p == least for _, p, _ in steps):
                    return True
        return False


def components(graph: dict[T, list[T]]) -> Iterator[list[T]]:
    """Strongly connected components (Tarjan 1972); successors that are no keys are left out."""
    order: dict[T, int] = {}
    low: dict[T, int] = {}
    stack: list[T] = []
    for root in graph:
        work = [(root, iter(graph[root]))] if root not in order else []
        while work:
            v, successors = work[-1]
            if v not in order:
                order[v] = low[v] = len(order)
                stack.append(v)
            for w in successors:
                if w in order:
                    low[v] = min(low[v], order[w])
                elif w in graph:
                    work.append((w, iter(graph[w])))
                    break
            else:
                work.pop()
                if work:
                    low[work[-1][0]] = min(low[work[-1][0]], low[v])
                if low[v] == order[v]:
                    component: list[T] = []
                    while not component or component[-1] != v:
                        component.append(stack.pop())
                        order[component[-1]] = sys.maxsize
                    yield component


# --- the question -----------------------------------------------------------------------------


def question_text(question: dict) -> str:
    """A question in the syntax of PRISM; what it has no syntax for follows as a comment."""
    path, objective = field(question, "path", dict), field(question, "objective", str)
    keys = PATHS[field(path, "kind", str)]
    bound = f"<={field(path, 'steps', int)}" if "steps" in keys else ""
    inner = f"C{bound}" if "reward" in keys else field(path, "formula", str, "")
    if "target" in keys:
        until = f"({field(path, 'stay', str)}) U" if "stay" in path else "F"
        inner = f"{until}{bound} ({field(path, 'target', str)})"
    head = f'R{{"{field(path, "reward", str)}"}}' if "reward" in keys else "P"
    nature = {"adversarial": OTHER[objective], "cooperative": objective}
    head += objective + nature.get(question.get("nature", ""), "")
    if "environment" in question:
        others = ",environment" if question["environment"] == "cooperative" else ""
        head = f"<<system{others}>> {head}"
    notes = [f"discount {field(path, 'discount', str)}"] if "discount" in keys else []
    notes += ["policy of the certificate"] if "policy" in question else []
    notes += ["policies see observations"] if "observations" in question else []
    return f"{head}=? [ {inner} ]" + (f" // {', '.join(notes)}" if notes else "")


class CertificateFile:
    """A certificate: its model, its question and its claims."""

    def __init__(self, contents: dict[str, bytes]) -> None:
        index = parse_json(contents, "certificate/index.json")
        only(index, "version", "producer", "numbers", "question", "claims", "members")
        valid = field(index, "version", int) == 1 and field(index, "numbers", str) == NUMBERS
        need(valid, f"the certificate is not of version 1 with numbers {NUMBERS!r}")
        self.contents, self.members = contents, field(index, "members", dict)
        self.claims = field(index, "claims", list)
        need(self.claims, "nothing is claimed")
        self.model, self.formulas = UmbModel(contents), Formulas()
        self.question = question = field(index, "question", dict)
        keys = ("objective", "nature", "environment", "policy", "memory", "next", "observations")
        self.path = path = field(only(question, "text", "path", *keys), "path", dict)
        self.kind, self.objective = field(path, "kind", str), field(question, "objective", str)
        hold(
            self.kind in PATHS,
            f"version 1 does not cover {self.kind!r:.40}, only {', '.join(PATHS)}",
        )
        only(path, "kind", *PATHS[self.kind])
        need(
            self.objective in OTHER, f"the objective {self.objective!r:.40} is neither max nor min"
        )
        self.nature = self._direction("nature", self.model.upper is not None)
        environment = self._direction("environment", self.model.num_players > 1)
        self.direction = [self.objective, environment, self.objective]  # of owners of states
        text = question_text(question)
        hold(question.get("text") == text, f"the text of the question is not {text!r}")
        self.automaton: HoaAutomaton | None = None
        self.trusted = ""
        if self.kind == "formula":
            self._read_automaton()

    def _direction(self, key: str, exists: bool) -> str:
        word = self.question.get(key)
        known = ("adversarial", "cooperative") if exists else (None,)
        need(word in known, f"{key} is {word!r:.40}, which does not fit the model")
        return OTHER[self.objective] if word == "adversarial" else self.objective

    def letters(self, names: Iterable[str]) -> tuple[list[frozenset[str]], list[int]]:
        """The sets of propositions that hold in some state, and the number of each state's set."""
        names = sorted(names)
        keys = list(zip(*map(self.model.label, names))) if names else [()] * self.model.num_states
        number = {key: i for i, key in enumerate(dict.fromkeys(keys))}
        sets = [frozenset(x for x, bit in zip(names, key) if bit) for key in number]
        return sets, [number[key] for key in keys]

    def states(self, text: str) -> list[bool]:
        """The states in which a formula without temporal operators holds."""
        f = self.formulas.parse(text)[0]
        letters, letter_of = self.letters(self.formulas.names)
        holds = [self.formulas.holds(f, letter) for letter in letters]
        return [holds[i] for i in letter_of]

    def _read_automaton(self) -> None:
        """Reads the automaton and compares it with the formula, on the letters of the model."""
        f, negation = self.formulas.parse(field(self.path, "formula", str))
        names = self.formulas.names
        name = f"certificate/{field(self.path, 'automaton', str)}.hoa"
        need(name in self.contents, f"{name:.80} is missing")
        self.automaton = automaton = HoaAutomaton(self.contents[name].decode())
        letters, self.letter_of = self.letters(names | {*automaton.columns})
        automaton.read_edges(self.formulas, letters)
        try:
            right = not automaton.meets(0, self.formulas, negation)
            hold(right, "the automaton accepts a word that violates the formula")
            right = not automaton.meets(1, self.formulas, f)
            hold(right, "the automaton rejects a word that satisfies the formula")
        except OverflowError:
            self.trusted = "the automaton, as its product with the formula's tableau is too large"

    def array(self, name: str, shape: list[int], *kinds: str) -> Sequence:
        """An array of the certificate."""
        entry = only(field(self.members, name, dict), "dtype", "shape")
        dtype, stored = field(entry, "dtype", str), field(entry, "shape", list)
        kind, size = re.fullmatch(r"([a-z]*)(\d{0,4})", dtype, re.ASCII).groups()  # type: ignore[union-attr]
        fits = stored == shape and kind in kinds
        need(fits, f"{name:.80}: {dtype:.20} {stored!s:.40}, expected {kinds} {shape}")
        member, count = f"certificate/{name}.bin", math.prod(shape)
        if kind == "uint":
            return read_integers(self.contents, member, {"32": "I", "64": "Q"}[size], count)
        return read_reals(self.contents, member, kind, int(size or 64), count, infinite=True)


# --- the conditions ---------------------------------------------------------------------------


class ClaimChecker:
    """The conditions of one claim: a bound in every initial state.

    Players that minimise for a lower bound, or maximise for an upper one, are universal: each of
    their rows has to satisfy the conditions. The policy of the others is fixed. The same holds for
    nature, which chooses a distribution within intervals: the best one is fixed.

    An option is a tuple: the successors of a row, the numerators of its probabilities, their
    denominator, upper ends if they are intervals, and the reward of each branch if there is one.
    """

    def __init__(self, file: CertificateFile, claim: dict) -> None:
        only(claim, "side", "bound", "values", "policy", "memory", "next")
        self.file, self.model, self.claim = file, file.model, claim
        side, question, path = field(claim, "side", str), file.question, file.path
        need(side in ("lower", "upper"), f"the side {side!r:.40} is neither lower nor upper")
        self.ours = "max" if side == "lower" else "min"
        # A lower bound of a formula is checked as an upper bound of its negation.
        self.is_negated = side == "lower" and file.kind == "formula"
        self.upper = side == "upper" or self.is_negated
        self.greatest = (file.nature == "max") != self.is_negated
        # The memory is of the policy of the claim or of the question, or counts the steps left.
        keepers = [x for x in (claim, question, path) if x.keys() & {"memory", "steps"}]
        hold(len(keepers) < 2, "two memories (or one and bounded steps) are not covered")
        is_twofold = "policy" in question and ("memory" in claim or "observations" in question)
        hold(not is_twofold, "a policy in the question, and memory or observations of another one")
        self.counts = "steps" in path
        self.memory = (
            path["steps"] + 1 if self.counts else field((*keepers, {})[0], "memory", int, 1)
        )
        num_automaton = file.automaton.num_states if file.automaton else 1
        axes = [num_automaton] * bool(file.automaton) + [self.memory] * len(keepers)
        self.shape, self.width = [self.model.num_states, *axes], math.prod(axes)
        self.values = file.array(field(claim, "values", str), self.shape, "double", "rational")
        self.next_memory: Sequence = []
        if keepers and not self.counts:
            self.next_memory = file.array(field(keepers[0], "next", str), self.shape, "uint")
            need(max(self.next_memory) < self.memory, "a memory state is out of range")
        self.fixed, self.policy = (self._policy(table) for table in (question, claim))
        # Where the player is existential and has a choice.
        self.is_ours = [
            has_choice
            and not (self.fixed and not owner)
            and file.direction[min(owner, 2)] == self.ours
            for has_choice, owner in zip(self.model.is_choice, self.model.owner)
        ]
        if "observations" in question and file.objective == self.ours and not self.fixed:
            self._check_observations(field(question, "observations", str))
        self._scale()

    def _policy(self, table: dict) -> Callable[[int], list] | None:
        """The function from a node to pairs of a weight and a row."""
        if "policy" not in table:
            return None
        name, start, width = field(table, "policy", str), self.model.row_start, self.width
        is_mixed = not field(field(self.file.members, name, dict), "dtype", str).startswith("uint")
        shape = [self.model.num_rows if is_mixed else self.shape[0], *self.shape[1:]]
        values = self.file.array(name, shape, "uint", "double", "rational")

        def choose(v: int) -> list:
            s, k = divmod(v, width)
            if is_mixed:
                rows = range(start[s], start[s + 1])
                pairs = [(Fraction(values[r * width + k]), r) for r in rows]
                hold(min(pairs)[0] >= 0 < max(pairs)[0], f"state {s}: the weights of the policy")
                return [(weight, r) for weight, r in pairs if weight]
            row = start[s] + values[v]
            hold(row < start[s + 1], f"state {s}: the policy has no choice {values[v]}")
            return [(1, row)]

        return choose

    def _check_observations(self, name: str) -> None:
        """The policy and its memory depend on observations alone."""
        seen, start = self.file.array(name, self.shape[:1], "uint"), self.model.row_start
        choice: dict[tuple, tuple] = {}
        for v in range(len(self.values)):
            s = v // self.width
            hold(self.policy, "a policy that sees observations is missing")
            rows = [(weight, r - start[s]) for weight, r in self.policy(v)]  # type: ignore[misc]
            actions = tuple(self.model.action[start[s] : start[s + 1]])
            entry = rows, actions, self.next_memory[v] if self.next_memory else 0
            is_same = choice.setdefault((seen[s], v % self.memory), entry) == entry
            hold(is_same, f"state {s}: the policy depends on more than observations")

    def _scale(self) -> None:
        """Values and rewards as integers over one denominator."""
        path, kind = self.file.path, self.file.kind
        parts = self.model.reward(path["reward"]) if "reward" in path else [[], [], []]
        discount = to_fraction(path.get("discount", "1"))
        hold(kind != "discounted" or 0 <= discount < 1, f"the discount is {discount}")
        self.is_signed = kind == "discounted" or any(min(x) < 0 for x in parts if x)
        self.infinite = infinite = {i for i, x in enumerate(self.values) if x == math.inf}
        allowed = kind == "reward" or (kind == "total" and self.upper)
        allowed = allowed and not self.is_signed
        hold(allowed or not infinite, f"the value of node {min(infinite, default=0)} is infinite")
        finite = [0.0 if x == math.inf else x for x in self.values] if infinite else self.values
        (x, *rewards), self.one = to_integers(finite, *parts)
        x = [self.one - y for y in x] if self.is_negated else x
        # Above all sums of a finite value and rewards; it stands for infinity.
        self.infinity = sum(max(map(abs, y), default=0) for y in (x, *rewards)) + self.one
        for i in infinite:
            x[i] = self.infinity
        self.current = self.following = x
        if discount < 1:
            self.current = [y * discount.denominator for y in x]
            self.following = [y * discount.numerator for y in x]
            rewards = [[y * discount.denominator for y in part] for part in rewards]
        self.rewards, self.has_rewards = rewards, any(rewards)

    def targets(self, r: int, v: int) -> Sequence[int]:
        """The successors of a row in a node."""
        states = self.model.target[self.model.branch_start[r] : self.model.branch_start[r + 1]]
        if self.width == 1:
            return states
        s, k = divmod(v, self.width)
        q, m = divmod(k, self.memory)
        if self.file.automaton:
            q = self.file.automaton.follow(self.file.letter_of[s], q)[0]
        m = m - 1 if self.counts else self.next_memory[v] if self.next_memory else m
        return [t * self.width + q * self.memory + m for t in states]

    def option(self, r: int, v: int) -> tuple:
        """The option of a row."""
        if not self.has_rewards:
            return (self.targets(r, v), *self.model.row(r), None)
        (of_state, of_row, of_branch), s = self.rewards, v // self.width
        reward = (of_state[s] if of_state else 0) + (of_row[r] if of_row else 0)
        branches = range(self.model.branch_start[r], self.model.branch_start[r + 1])
        rewards = (
            [reward + of_branch[i] for i in branches] if of_branch else [reward] * len(branches)
        )
        return (self.targets(r, v), *self.model.row(r), rewards)

    def options(self, v: int, free: bool) -> list[tuple]:
        """The options of a node that remain, or those of all policies of the question."""
        model, s = self.model, v // self.width
        if self.fixed and model.owner[s] == 0:
            pairs = self.fixed(v)
        elif self.policy and self.is_ours[s] and not free:
            pairs = self.policy(v)
        else:
            return [self.option(r, v) for r in range(model.row_start[s], model.row_start[s + 1])]
        options = [self.option(r, v) for _, r in pairs]
        if len(options) == 1:
            return options
        hold(model.upper is None, "randomised policies of interval models are not covered")
        mixed = [w * Fraction(n, o[2]) for (w, _), o in zip(pairs, options) for n in o[1]]
        (mass,), _ = to_integers(mixed)
        rewards = [x for o in options for x in o[4] or ()]
        return [([t for o in options for t in o[0]], mass, sum(mass), None, rewards)]

    def explore(self, is_final: Callable[[int], bool], free: bool = False) -> Graph:
        """The options of all nodes that are reachable from initial states; none of final nodes."""
        q = self.file.automaton.initial if self.file.automaton else 0
        start = q * self.memory + (self.memory - 1 if self.counts else 0)
        pending = [s * self.width + start for s, x in enumerate(self.model.initial) if x]
        graph: Graph = {}
        seen = bytearray(len(self.values))
        for v in pending:
            seen[v] = 1
        for v in pending:  # the list grows
            graph[v] = [] if is_final(v) else self.options(v, free)
            for option in graph[v]:
                for t in option[0]:
                    if not seen[t]:
                        seen[t] = 1
                        pending.append(t)
        return graph

    def distribution(self, option: tuple) -> tuple[list, list]:
        """Values of successors with rewards, and numerators of their probabilities.

        The best distribution within intervals is greedy: what is missing to 1 goes to the
        successors in the order of their values.
        """
        targets, low, total, high, reward = option
        following = self.following
        values = [following[t] for t in targets]
        if reward:
            values = [x + y for x, y in zip(values, reward)]
        if high:
            low, missing = low[:], total - sum(low)
            for i in sorted(range(len(low)), key=values.__getitem__, reverse=self.greatest):
                more = min(missing, high[i] - low[i])
                low[i] += more
                missing -= more
        return values, low

    def is_inductive(self, v: int, options: list[tuple]) -> bool:
        """True if the bound of a node follows from the bounds of its successors."""
        x = self.current[v]
        some = len(options) > 1 and self.is_ours[v // self.width]
        for option in options:
            values, mass = self.distribution(option)
            if self.infinite and any(n and y >= self.infinity for n, y in zip(mass, values)):
                holds = not self.upper
            else:
                expected = sum(map(mul, mass, values))
                holds = x * option[2] >= expected if self.upper else x * option[2] <= expected
            if holds == some:
                return some
        return not some

    def support(self, option: tuple, free: bool) -> Sequence[int]:
        """Successors that an option has for every choice of a universal nature."""
        targets, low, _, high, _ = option
        if high and not free and self.file.nature == self.ours:
            # Successors with the value of the last one that is filled may share what it gets.
            values, mass = self.distribution(option)
            partly = [x for x, a, b in zip(values, low, mass) if b > a]
            last = (min if self.greatest else max)(partly, default=None)
            low = [n or b * (x == last) for x, n, b in zip(values, mass, high)]
        return targets if all(low) else [t for t, n in zip(targets, low) if n]

    def earns(self, option: tuple) -> bool:
        """True if an option has a positive reward, whatever distribution nature chooses."""
        rewards = option[4] or (0,)
        return any(map(mul, option[1], rewards)) or all(rewards)

    def staying(self, graph: Graph, nodes: Iterable[int], final: set[int], free: bool) -> Graph:
        """The largest set of nodes in which each has an option that stays in it or in `final`.

        Returns the successors under the options that stay.
        """
        is_open = self.model.upper is not None and (free or self.file.nature != self.ours)
        kept = {v: [(self.support(o, free), o) for o in graph[v]] for v in nodes}
        inside = {*kept, *final}
        sources: Graph = {}
        for v, options in kept.items():
            for t in {t for certain, o in options for t in (o[0] if is_open else certain)}:
                sources.setdefault(t, []).append(v)

        def stays(certain: Sequence[int], option: tuple) -> bool:
            if not inside.issuperset(certain):
                return False
            targets, _, total, high, _ = option
            return not is_open or total <= sum(n for t, n in zip(targets, high) if t in inside)

        pending = [*kept]
        while pending:
            v = pending.pop()
            if v in kept and not any(stays(*pair) for pair in kept[v]):
                inside.discard(v)
                del kept[v]
                pending += sources.get(v, ())
        successors: Graph = {}
        for v, options in kept.items():
            part = [(o if is_open else None, x) for x, o in options if stays(x, o)]
            successors[v] = [
                t
                for o, certain in part
                for t in (
                    certain if o is None else [t for t, n in zip(o[0], o[3]) if n and t in inside]
                )
            ]
        return successors

    def almost_sure(self, graph: Graph, nodes: Iterable[int], final: set[int]) -> set[int]:
        """The nodes from which universal players can reach a final one almost surely."""
        kept = {*nodes}
        while True:
            steps = self.staying(graph, kept, final, False)
            reaching = {*final}
            sources: Graph = {}
            for v, successors in steps.items():
                for t in successors:
                    sources.setdefault(t, []).append(v)
            pending = [*final]
            while pending:
                fresh = {*sources.pop(pending.pop(), ())} - reaching
                reaching |= fresh
                pending += fresh
            if (reaching := reaching - final) == kept:
                return kept
            kept = reaching

    def accepting(self, graph: Graph) -> set[int]:
        """The union of the end components whose least priority is even (odd for a negation)."""
        automaton, letter_of, priority = self.file.automaton, self.file.letter_of, {}
        union: set[int] = set()
        for v in graph:
            s, k = divmod(v, self.width)
            priority[v] = automaton.follow(letter_of[s], k // self.memory)[1]  # type: ignore[union-attr]
        for least in {p for p in priority.values() if p % 2 == self.is_negated}:
            pending = [[v for v in graph if priority[v] >= least]]
            while pending:
                part = self.staying(graph, pending.pop(), set(), False)
                if len(parts := [*components(part)]) > 1:
                    pending += parts
                elif any(priority[v] == least for v in part):
                    union.update(part)
        return union

    def place(self, v: int) -> str:
        s, k = divmod(v, self.width)
        more = f", automaton state {k // self.memory}" if self.file.automaton else ""
        return f"{self.claim['side']} bound: state {s}{more}" + f", memory {k % self.memory}" * (
            self.memory > 1
        )

    def check(self) -> tuple[int, str]:
        """Checks the claim; returns the number of nodes, and what the claim says."""
        path, kind, upper, width = self.file.path, self.file.kind, self.upper, self.width
        is_reward, x = "reward" in path, self.current
        target = self.file.states(field(path, "target", str, "false"))
        stay = self.file.states(field(path, "stay", str, "true"))
        is_last = [self.counts and not m for m in range(self.memory)]

        def is_final(v: int) -> bool:
            return target[v // width] or not stay[v // width] or is_last[v % self.memory]

        is_upper_reward = kind == "reward" and upper
        needs_policy = (
            kind == "formula" or is_upper_reward or (kind in ("until", "total") and not upper)
        )
        missing = [s for s, x in enumerate(self.is_ours) if x]
        hold(self.policy or not needs_policy or not missing, f"state {missing[:1]} needs a policy")
        hold(kind != "total" or not self.is_signed, "total rewards of both signs are not covered")
        graph = self.explore(is_final)
        final = {v for v in graph if is_final(v)}
        accepted = self.accepting(graph) if kind == "formula" else set()
        for v, options in graph.items():
            if v in final or v in accepted:
                is_one = not is_reward and (target[v // width] or v in accepted)
                edge = self.one if is_one else 0
                holds = x[v] >= edge if upper else x[v] <= edge
            elif v in self.infinite:
                holds = True
            elif upper:
                is_trivial = x[v] >= self.one and not is_reward
                holds = x[v] >= 0 or self.is_signed
                holds = holds and (is_trivial or self.is_inductive(v, options))
            else:
                is_trivial = x[v] <= 0 and not self.is_signed
                holds = is_trivial or self.is_inductive(v, options)
            if not holds:
                raise Refusal(f"{self.place(v)}: the value does not follow from its successors")

        def never(graph: Graph, nodes: Iterable[int], free: bool, why: str) -> None:
            stuck = self.staying(graph, nodes, set(), free)
            hold(not stuck, f"{self.place(min(stuck, default=0))}: {why}")

        nodes = [v for v in graph if v not in final]
        infinite = self.infinite & {*nodes}
        if kind in ("until", "total", "within") and not upper:
            # Paths that stay and earn rewards for ever have an infinite total.
            idle = {v: [o for o in graph[v] if not self.earns(o)] for v in nodes}
            positive = (v for v in nodes if x[v] > 0)
            never(idle, positive, False, "paths may stay forever where values are above 0")
        elif kind == "reward" and self.is_signed:
            graph_of_all = self.explore(is_final, free=True)
            others = (v for v in graph_of_all if not is_final(v))
            never(graph_of_all, others, True, "rewards of both signs, and the target may be missed")
        elif kind == "reward" and upper:
            never(graph, {*nodes} - infinite, False, "paths may miss the target forever")
        elif infinite:
            wrong = infinite & self.almost_sure(graph, nodes, final)
            first = self.place(min(wrong, default=0))
            hold(not wrong, f"{first}: the target can be reached almost surely, no infinity")
        return len(graph), self._bound(next(iter(graph)) % self.width)

    def _bound(self, start: int) -> str:
        """The claim as text, after comparing its bound with the values of initial states."""
        text, is_lower = field(self.claim, "bound", str), self.ours == "max"
        bound = math.inf if text == "inf" else to_fraction(text)
        nodes = [s * self.width + start for s, x in enumerate(self.model.initial) if x]
        worst = (min if is_lower else max)(nodes, key=self.values.__getitem__)
        value: Any = self.values[worst]
        value = value if value == math.inf else Fraction(value)
        holds = value >= bound if is_lower else value <= bound
        hold(holds, f"{self.place(worst)}: {value!s:.40} is beyond {text:.40}")
        sign = ">=" if is_lower else "<="
        return f"{self.file.question['text']} is {sign} {text} in every initial state"


def main(arguments: Sequence[str] | None = None) -> int:
    """Checks a file and prints the outcome; returns the exit status."""
    parser = argparse.ArgumentParser(description="Check a certificate by exact arithmetic.")
    parser.add_argument("file")
    parser.add_argument("--limit", type=int, default=2**30, help="most bytes of the archive")
    options = parser.parse_args(arguments)
    status, lines = 0, []
    gc.disable()  # nothing here is cyclic, and there are millions of tuples
    try:
        file = CertificateFile(read_archive(options.file, options.limit))
        for claim in file.claims:
            num_nodes, text = ClaimChecker(file, claim).check()
            lines += [f"claimed: {text}", f"checked: {num_nodes} nodes of the claim's graph"]
        trusted = "" if not file.trusted else ", given the automaton"
        lines += [f"on trust: that the model is the one meant; {file.trusted or 'nothing else'}"]
        lines += [f"ACCEPTED{trusted}"]
    except Refusal as why:
        status, lines = 1, [f"REFUSED: {why}"]
    except Exception as why:  # no error of any kind is an acceptance
        status, lines = 2, [f"not a certificate: {type(why).__name__}: {why}"]
    gc.enable()
    for line in lines:
        print("".join(c if c.isprintable() else "?" for c in line[:2000]))
    return status


if __name__ == "__main__":
    sys.exit(main())
