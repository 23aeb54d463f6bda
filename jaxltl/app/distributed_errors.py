"""Failures of JAX's distributed runtime in one line, by a second process that watches the first.

Runs as another program, with the process's number as argument and its error output as standard
input, since the runtime ends its process at once. Imports nothing of the package.
"""

from __future__ import annotations

import os
import re
import signal
import sys
import threading

FATAL = "Terminating process because the JAX distributed service detected"
END = "jaxltl ends: "  # prefix of the process's own last line
AGAIN = (
    "Checkpoints are kept: start all processes again, in the same or another number, and the "
    "run resumes"
)
# Patterns of the runtime's last message, and what follows the process's number; the first match counts.
_REASONS = (
    (
        "RegisterTask.*ALREADY_EXISTS|ALREADY_EXISTS.*RegisterTask",
        ": another process has the same number; give each its own --process, from 0 to one less "
        "than --processes.",
    ),
    (
        "RegisterTask",
        ": not all processes have joined in time; start as many as --processes says, all with the "
        "same --coordinator, or give them longer by --wait.",
    ),
    (
        "PollForError.*Failed to send RPC|Failed to send RPC.*PollForError|Socket closed",
        f" stops: process 0, which coordinates the others, has ended. {AGAIN}.",
    ),
)
_CHATTER = ("[Gloo] Rank ",)
_WAIT = 1.0  # seconds for the rest of a message


def explain(text: str, process: int) -> str:
    """One-line explanation of the last message of the runtime."""
    if (own := re.search(f"^{END}(.+)$", text, re.MULTILINE)) is not None:
        return own[1]
    silent = re.search(r"stopped sending heartbeats\):\n([\d,\s]+)", text)
    if silent is not None:
        names = re.findall(r"\d+", silent[1])
        who = f"process {names[0]} does" if len(names) == 1 else f"processes {', '.join(names)} do"
        return f"process {process} stops: {who} not respond. {AGAIN}."
    for pattern, reason in _REASONS:
        if re.search(pattern, text, re.DOTALL):
            return f"process {process}{reason}"
    return f"process {process} stops: another process has ended. {AGAIN}."


def main() -> None:
    """Copies lines until the last message or the end of the process, and explains that."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the observed process handles it
    process, last = int(sys.argv[1]), list[str]()
    done = threading.Event()

    def read() -> None:
        for raw in sys.stdin.buffer:
            line = raw.decode(errors="replace")
            if last or END in line or FATAL in line:
                last.append(line)
                begun.set()
            elif not line.startswith(_CHATTER):
                sys.stderr.write(line)
                sys.stderr.flush()
        done.set()
        begun.set()

    begun = threading.Event()
    threading.Thread(target=read, daemon=True).start()
    begun.wait()
    done.wait(_WAIT)  # subprocesses may hold the pipe open
    if last:
        sys.stderr.write(f"error: {explain(''.join(last), process)}\n")
        sys.stderr.flush()
    os._exit(0)  # the thread may still be reading


if __name__ == "__main__":
    main()
