"""Run one command as a child and print what it cost, as JSON. Imports the standard library's smallest part only:

a child's peak memory, as the kernel counts it, starts with that of the process it was forked from.
"""

import json
import os
import subprocess
import sys
import time


def measured(command):
    """CPU seconds (user and system, children included), wall seconds, peak resident memory in bytes, exit code."""
    start = time.perf_counter()
    # A user's modules are compiled once, as those of all installed programs are, not by every process.
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONDONTWRITEBYTECODE"}
    pipes = {"stdin": subprocess.DEVNULL, "stdout": subprocess.DEVNULL, "stderr": subprocess.PIPE}
    child = subprocess.Popen(command, env=environment, **pipes)
    talk = child.stderr.read()
    _, status, usage = os.wait4(child.pid, 0)
    return {
        "cpu": usage.ru_utime + usage.ru_stime,
        "wall": time.perf_counter() - start,
        "memory": usage.ru_maxrss * (1 if sys.platform == "darwin" else 1024),
        "code": os.waitstatus_to_exitcode(status),
        "stderr": talk[-2000:].decode(errors="replace"),
    }


if __name__ == "__main__":
    print(json.dumps(measured(sys.argv[1:])))
