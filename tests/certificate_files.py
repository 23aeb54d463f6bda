"""Certificates for tests, written without jaxltl: models as lists, members as bytes."""

import gzip
import io
import json
import struct
import tarfile
from fractions import Fraction

NUMBERS = "exact values, normalised rows"


def bits(flags):
    words = [0] * -(-len(flags) // 64)
    for i, flag in enumerate(flags):
        words[i // 64] |= int(flag) << (i % 64)
    return struct.pack(f"<{len(words)}Q", *words)


def words(values, code="Q"):
    return struct.pack(f"<{len(values)}{code}", *values)


def doubles(values):
    return struct.pack(f"<{len(values)}d", *values)


def rationals(values, size=128):
    """Bytes of a numerator and a denominator each."""
    ratios = [Fraction(x).as_integer_ratio() for x in values]
    return b"".join(
        n.to_bytes(size, "little", signed=True) + d.to_bytes(size, "little") for n, d in ratios
    )


def starts(groups):
    ends = [0]
    for group in groups:
        ends.append(ends[-1] + len(group))
    return words(ends)


def model(states, *, labels=(), rewards=(), owner=None, initial=(0,), actions=None):
    """Members of a UMB file: for each state its rows, of pairs of a target and a probability.

    A probability is a double, or a pair of doubles; `rewards` are lists of states, rows or branches.
    """
    rows = [row for state in states for row in state]
    branches = [branch for row in rows for branch in row]
    is_interval = isinstance(branches[0][1], tuple)
    numbers = [x for _, p in branches for x in (p if is_interval else (p,))]
    kind = "double-interval" if is_interval else "double"
    counts = {"states": len(states), "choices": len(rows), "branches": len(branches)}
    members = {
        "state-to-choices.bin": starts(states),
        "choice-to-branches.bin": starts(rows),
        "branch-to-target.bin": words([t for t, _ in branches]),
        "branch-to-probability.bin": doubles(numbers),
        "state-is-initial.bin": bits([s in initial for s in range(len(states))]),
    }
    described = {"aps": {}, "rewards": {}}
    for name, chosen in dict(labels).items():
        described["aps"][name] = {"applies-to": ["states"], "type": {"type": "bool", "size": 1}}
        member = f"annotations/aps/{name}/states/values.bin"
        members[member] = bits([s in chosen for s in range(len(states))])
    for name, parts in dict(rewards).items():
        described["rewards"][name] = {"applies-to": [*parts], "type": {"type": "double"}}
        for part, values in parts.items():
            members[f"annotations/rewards/{name}/{part}/values.bin"] = doubles(values)
    if owner is not None:
        members["state-to-player.bin"] = words(owner, "I")
    if actions is not None:
        members["actions/choices/values.bin"] = words(actions, "I")
    system = {
        "time": "discrete",
        "#players": 2 if owner else 1,
        "#initial-states": len(initial),
        "branch-probability-type": {"type": kind, "size": 128 if is_interval else 64},
        **{f"#{key}": count for key, count in counts.items()},
    }
    index = {"format-version": 1, "transition-system": system, "annotations": described}
    return {"index.json": json.dumps(index).encode(), **members}


def certificate(members, question, claims, arrays, texts=()):
    """Adds a certificate to the members: `arrays` are by name a dtype, a shape and values."""
    packers = {"double": doubles, "uint32": lambda x: words(x, "I"), "uint64": words}
    index = {
        "version": 1,
        "numbers": NUMBERS,
        "producer": "tests",
        "question": question,
        "claims": claims,
        "members": {name: {"dtype": d, "shape": shape} for name, (d, shape, _) in arrays.items()},
    }
    added = {"certificate/index.json": json.dumps(index).encode()}
    for name, (dtype, _, values) in arrays.items():
        added[f"certificate/{name}.bin"] = packers.get(dtype, rationals)(values)
    for name, text in dict(texts).items():
        added[f"certificate/{name}.hoa"] = text.encode()
    return {**members, **added}


def write(path, members, *, compress=True):
    """Writes a tar archive; `members` are a dictionary, or pairs, so that names may repeat."""
    plain = io.BytesIO()
    with tarfile.open(fileobj=plain, mode="w", format=tarfile.USTAR_FORMAT) as archive:
        for name, data in members.items() if isinstance(members, dict) else members:
            info = tarfile.TarInfo(name)
            info.size = len(data)
            archive.addfile(info, io.BytesIO(data))
    data = plain.getvalue()
    path.write_bytes(gzip.compress(data, 1) if compress else data)
    return path
