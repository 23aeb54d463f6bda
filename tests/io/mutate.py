"""Mutations of text files: bytes changed, and pieces lost, repeated or replaced."""

import numpy as np

WORDS = [
    b"0",
    b"-1",
    b"1e999",
    b"nan",
    b"inf",
    b"99999999999999999999",
    b"1/0",
    b"[0,1]",
    b"[0.25, 0.75]",
    b"[",
    b"]",
    b"\n",
    b" ",
    b"\t",
    b"\xff",
    b"\0",
    b'"',
    b":",
    b"#",
    b"//",
    b"$",
    b"@",
    b"state",
    b"action",
    b"init",
    b"(",
    b")",
    b",",
    b"4294967296",
    b"2147483647",
    b"mdp",
    b"\r\n",
    b"",
    *b"' & | ! ; { } {9} [t] F G 1e5 parity State: --END-- controllable-AP: \x80 \xc3\xa9".split(),
]


def mutated(rng: np.random.Generator, data: bytes) -> bytes:
    """One to four mutations."""
    for _ in range(rng.integers(1, 5)):
        i, j = sorted(rng.integers(0, len(data) + 1, 2).tolist())
        j = min(j, i + int(rng.integers(1, 40)))
        kind = rng.integers(6)
        if kind == 0:
            data = data[:i] + bytes([rng.integers(256)]) + data[i + 1 :]
        elif kind == 1:
            data = data[:i] + data[j:]
        elif kind == 2:
            data = data[:j] + data[i:j] + data[j:]
        elif kind == 3:
            data = data[:i] + WORDS[rng.integers(len(WORDS))] + data[i:]
        elif kind == 4:
            data = data[:i]
        else:
            words = data.split(b" ")
            words[rng.integers(len(words))] = WORDS[rng.integers(len(WORDS))]
            data = b" ".join(words)
    return data
