"""Sizes of automata relative to the best known ones: ``python -m benchmarks.automata_sizes FILE``.

FILE is a JSON list of ``{"formula": "G F a", "states": 2}``. A sink that no word is accepted from is
not counted, as automata of other tools leave it out.
"""

from __future__ import annotations

import argparse
import json
import time
from pathlib import Path

import numpy as np

from jaxltl.core.automata.translate import to_automaton
from jaxltl.core.environments.monitor import Verdict, verdicts


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("file", type=Path)
    known = json.loads(parser.parse_args().file.read_text())
    rows = []
    for one in known:
        before = time.process_time()
        automaton = to_automaton(one["formula"])
        seconds = time.process_time() - before
        sinks = int((np.asarray(verdicts(automaton)) == Verdict.VIOLATED).sum())
        size = max(len(automaton.delta) - sinks, 1)
        rows.append((size / one["states"], size, one["states"], seconds, one["formula"]))
    sizes, best = (sum(row[i] for row in rows) for i in (1, 2))
    print(f"{len(rows)} formulas: {sizes} states, best known {best}, ratio {sizes / best:.3f}")
    print(f"largest ratio {max(rows)[0]:.3f}, longest {max(row[3] for row in rows):.2f} s")
    for ratio, size, states, seconds, formula in sorted(rows, reverse=True)[:5]:
        print(f"{ratio:6.3f} {size:5} {states:5} {seconds:6.2f} s  {formula}")


if __name__ == "__main__":
    main()
