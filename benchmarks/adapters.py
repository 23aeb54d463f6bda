"""``python -m benchmarks.adapters [PACKAGE ...]``: adapters with the newest releases of their packages.

For each package, a fresh virtual environment receives this repository with the package's extra, which
pip resolves to the newest release, and runs the comparison of 1,000 steps through the adapter with the
package's own. Prints a table; the exit status is 1 if a package cannot be installed, or a step differs.
Made for a weekly job. Environments are made one after the other and deleted.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import NamedTuple
from xml.etree import ElementTree

ROOT = Path(__file__).parent.parent
ADAPTERS = (
    "brax",
    "craftax",
    "gymnax",
    "jaxmarl",
    "jumanji",
    "navix",
    "pgx",
    "playground",
    "xminigrid",
)
# The package, which is also the name of the extra, and the tests that compare the steps.
TESTS = {name: f"tests/envs/adapters/test_{name}.py" for name in ADAPTERS}
TESTS["gymnasium"] = "tests/envs/test_gymnasium_vector.py"
VERSIONS = "import sys, importlib.metadata as m; print(*(m.version(x) for x in sys.argv[1:]))"


class Row(NamedTuple):
    """Result for a package: installed versions, ``"equal"`` or the failure, and wall seconds."""

    package: str
    version: str
    jax: str
    result: str
    seconds: float

    @property
    def passed(self) -> bool:
        """True if all steps are equal."""
        return self.result == "equal"


def check(package: str, minutes: float = 30) -> Row:
    """Installs the newest release of a package and compares 1,000 steps."""
    begin, version, jax = time.monotonic(), "", ""
    with tempfile.TemporaryDirectory() as folder:
        python = f"{folder}/bin/python"

        def call(*words: str) -> str:
            command = [python, *words]
            return subprocess.run(
                command, cwd=ROOT, check=True, capture_output=True, text=True, timeout=60 * minutes
            ).stdout

        try:
            subprocess.run([sys.executable, "-m", "venv", folder], check=True, timeout=300)
            # Without bytecode, which takes as long to compile as the packages to download.
            install = ["install", "-q", "--no-compile", "pytest", "pytest-xdist"]
            call("-m", "pip", *install, f".[{package}]")
            version, jax = call("-c", VERSIONS, package, "jax").split()
            report = f"{folder}/report.xml"
            options = ["-n", "0", "-m", "", "-k", "thousand", f"--junitxml={report}"]
            call("-m", "pytest", *options, TESTS[package])
            result = result_of(ElementTree.parse(report).getroot())
        except subprocess.CalledProcessError as problem:
            sys.stderr.write((problem.stdout or "") + (problem.stderr or ""))
            lines = ((problem.stdout or "") + (problem.stderr or "")).strip().splitlines()
            errors = [x for x in lines if x.startswith(("ERROR", "FAILED", "E  "))]
            result = (errors or lines or ["failed"])[-1][:200]
        except subprocess.TimeoutExpired:
            result = f"not done after {minutes:g} minutes"
    return Row(package, version, jax, result, time.monotonic() - begin)


def result_of(report: ElementTree.Element) -> str:
    """``"equal"`` if a JUnit report has tests, all of which ran and passed; else the counts."""
    names = ("tests", "failures", "errors", "skipped")
    tests, *others = (sum(int(x.get(name, 0)) for x in report.iter("testsuite")) for name in names)
    if tests and not any(others):
        return "equal"
    return ", ".join(
        f"{n} {name}" for n, name in zip((tests, *others), names, strict=True) if n
    ) or ("no test ran")


def main() -> None:
    """Prints the table; exits with 1 if a package fails."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.adapters", description=__doc__)
    parser.add_argument("packages", nargs="*", metavar="PACKAGE", help=f"of {', '.join(TESTS)}")
    parser.add_argument("--minutes", type=float, default=30, help="limit of a step of a package")
    asked = parser.parse_args()
    if unknown := set(asked.packages) - set(TESTS):
        parser.error(f"no adapter for {', '.join(sorted(unknown))}; choose of {', '.join(TESTS)}")
    print("| package | version | JAX | 1,000 steps | seconds |\n|---|---|---|---|---|", flush=True)
    failed = False
    for package in asked.packages or TESTS:
        row = check(package, asked.minutes)
        failed |= not row.passed
        print(
            f"| {row.package} | {row.version} | {row.jax} | {row.result} | {row.seconds:.0f} |",
            flush=True,
        )
    sys.exit(failed)


if __name__ == "__main__":
    main()
