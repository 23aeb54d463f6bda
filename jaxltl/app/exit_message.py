"""Reads what the runtime of a process writes, and tells in one line why it ended that process.

Run as a program of its own, beside the process, since the runtime ends that at once: with the
process's number as argument, and its lines as standard input. It imports nothing of the package.
"""

from __future__ import annotations

import os
import re
import signal
import sys
import threading

FATAL = "Terminating process because the JAX distributed service detected"
END = "jaxltl ends: "  # what the process itself says, which may not live to see it printed
AGAIN = (
    "what was saved is kept: start all processes again, as many or another number, and the "
    "run goes on"
)
_CHATTER = ("[Gloo] Rank ",)
_PATIENCE = 1.0  # seconds for the rest of a message


def told(text: str, process: int) -> str:
    """The line for the runtime's last words.

    Example:
      >>> told("Terminating process ...: UNAVAILABLE: The following tasks are unhealthy "
      ...      "(stopped sending heartbeats):\\n1\\nThe tasks have crashed.", 0)[:44]
      'process 0 stops, for process 1 gives no sign'
    """
    if (own := re.search(f"^{END}(.+)$", text, re.MULTILINE)) is not None:
        return own[1]
    silent = re.search(r"stopped sending heartbeats\):\n([\d,\s]+)", text)
    if silent is not None:
        names = re.findall(r"\d+", silent[1])
        who = (
            f"process {names[0]} gives"
            if len(names) == 1
            else (f"processes {', '.join(names)} give")
        )
        return f"process {process} stops, for {who} no sign of life any more; {AGAIN}."
    if "RegisterTask" in text and "ALREADY_EXISTS" in text:
        return (
            f"process {process}: another process has the same number; give each its own "
            "--process, from 0 to one less than --processes."
        )
    if "RegisterTask" in text:
        return (
            f"process {process}: not all processes have joined in time; start as many as "
            "--processes says, all with the same --coordinator, or give them longer by --wait."
        )
    if ("PollForError" in text and "Failed to send RPC" in text) or "Socket closed" in text:
        return (
            f"process {process} stops, for process 0, which the others meet at, has ended; {AGAIN}."
        )
    return f"process {process} stops, for another process has ended; {AGAIN}."


def main() -> None:
    """Passes lines on until the last words come, or the process has ended; of these one line."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the process that is read from decides
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
    done.wait(_PATIENCE)  # what the process has started may hold the other end for longer
    if last:
        sys.stderr.write(f"error: {told(''.join(last), process)}\n")
        sys.stderr.flush()
    os._exit(0)  # the thread may still be reading


if __name__ == "__main__":
    main()
