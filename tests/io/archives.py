"""UMB archives made by hand: an example, and archives of any members."""

import io
import json
import tarfile

import numpy as np


def tar(members, form=tarfile.USTAR_FORMAT, *, folders=False) -> bytes:
    """A plain archive of members, by name, in their order."""
    file = io.BytesIO()
    with tarfile.open(fileobj=file, mode="w", format=form) as archive:
        for name, content in members.items() if isinstance(members, dict) else members:
            if folders and "/" in name:
                folder = tarfile.TarInfo(name.rpartition("/")[0])
                folder.type = tarfile.DIRTYPE
                archive.addfile(folder)
            info = tarfile.TarInfo(name)
            info.size = len(content)
            archive.addfile(info, io.BytesIO(content))
    return file.getvalue()


def members_of(data: bytes) -> list[tuple[str, bytes]]:
    """The regular files of a plain archive."""
    with tarfile.open(fileobj=io.BytesIO(data)) as archive:
        return [(x.name, archive.extractfile(x).read()) for x in archive if x.isfile()]


def u64(*numbers) -> bytes:
    return np.array(numbers, "<u8").tobytes()


def f64(*numbers) -> bytes:
    return np.array(numbers, "<f8").tobytes()


def u32(*numbers) -> bytes:
    return np.array(numbers, "<u4").tobytes()


def bits(*truth) -> bytes:
    return sum(x << i for i, x in enumerate(truth)).to_bytes(-(-len(truth) // 64) * 8, "little")


BOOL, DOUBLE, RATIONAL = {"type": "bool"}, {"type": "double", "size": 64}, {"type": "rational"}


def example():
    """The index and the members of a decision process of four states.

    Choices: 0 {a: .5 to 1, .5 to 2; b: .2 to 2, .8 to 3}, 1 {a: .9 to 0, .1 to 1}, 2 and 3 loop.
    """
    index = {
        "format-version": 1,
        "format-revision": 0,
        "model-data": {},
        "file-data": {"tool": "by hand", "creation-date": 1},
        "transition-system": {
            "time": "discrete",
            "#players": 1,
            "#states": 4,
            "#initial-states": 1,
            "#choices": 5,
            "#choice-actions": 2,
            "#branches": 8,
            "#branch-actions": 0,
            "#observations": 0,
            "branch-probability-type": DOUBLE,
        },
        "annotations": {
            "aps": {"g": {"alias": "Goal!", "applies-to": ["states"], "type": BOOL}},
            "rewards": {"r": {"applies-to": ["choices", "branches"], "type": DOUBLE}},
        },
        "valuations": {
            "states": {
                "unique": True,
                "classes": [
                    {
                        "variables": [
                            {"name": "x", "type": {"type": "uint", "size": 2}, "offset": -1},
                            {"name": "b", "type": {"type": "bool", "size": 1}},
                            {"padding": 5},
                        ]
                    }
                ],
            }
        },
    }
    members = {
        "state-to-choices.bin": u64(0, 2, 3, 4, 5),
        "choice-to-branches.bin": u64(0, 2, 4, 6, 7, 8),
        "branch-to-target.bin": u64(1, 2, 2, 3, 0, 1, 2, 3),
        "branch-to-probability.bin": f64(0.5, 0.5, 0.2, 0.8, 0.9, 0.1, 1, 1),
        "state-is-initial.bin": bits(1, 0, 0, 0),
        "actions/choices/values.bin": u32(0, 1, 0, 0, 0),
        "actions/choices/string-mapping.bin": u64(0, 1, 2),
        "actions/choices/strings.bin": b"ab",
        "annotations/aps/g/states/values.bin": bits(0, 0, 0, 1),
        "annotations/rewards/r/choices/values.bin": f64(0, 1, 0, 0, 0),
        "annotations/rewards/r/branches/values.bin": f64(1, 2, 3, 4, 5, 6, 7, 8),
        "valuations/states/valuations.bin": bytes([0b000, 0b001, 0b010, 0b110]),
    }
    return index, members


def classes_example():
    """The same with rational probabilities, and variables of all types in two classes."""
    index, members = example()
    index["transition-system"]["branch-probability-type"] = {"type": "rational", "size": 128}
    members["branch-to-probability.bin"] = u64(1, 2, 1, 2, 1, 5, 4, 5, 9, 10, 1, 10, 1, 1, 2, 2)
    first = [
        {"name": "k", "type": {"type": "int", "size": 5}},
        {"name": "o", "is-optional": True, "type": {"type": "uint", "size": 3}, "offset": 7},
        {"name": "s", "type": {"type": "string"}},
        {"padding": 7},
    ]
    second = [
        {"name": "k", "type": {"type": "int", "size": 8}},
        {"name": "d", "type": {"type": "double"}},
        {"name": "q", "type": {"type": "rational"}},
    ]
    index["valuations"] = {
        "states": {
            "unique": False,
            "#strings": 2,
            "classes": [{"variables": first}, {"variables": second}],
        }
    }

    def one(k, there, o, s):
        packed = k % 32 | there << 5 | o << 6 | s << 9
        return packed.to_bytes(10, "little")

    def two(k, d, above, below):
        return np.int8(k).tobytes() + f64(d) + np.int64(above).tobytes() + u64(below)

    members |= {
        "valuations/states/valuations.bin": one(-3, True, 5, 1)
        + two(-100, 0.25, -1, 3)
        + one(15, False, 0, 0)
        + one(2, True, 0, 1),
        "valuations/states/valuation-to-class.bin": u32(0, 1, 0, 0),
        "valuations/states/string-mapping.bin": u64(0, 2, 5),
        "valuations/states/strings.bin": "é".encode() + b"end",
    }
    return index, members


def umb(index, members, **options) -> bytes:
    """A plain archive of an index and members, the index first."""
    return tar({"index.json": json.dumps(index).encode(), **members}, **options)
