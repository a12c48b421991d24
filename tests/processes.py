"""What a command leaves running, as /proc says."""

from __future__ import annotations

from pathlib import Path


def state(stat: Path) -> list[str]:
    """Return the fields of a process's ``stat`` after its name: state, parent, group, session and so on."""
    return stat.read_text().rpartition(")")[2].split()


def alive(pid: int) -> bool:
    """Return whether a process is there and no zombie."""
    try:
        return state(Path(f"/proc/{pid}/stat"))[0] != "Z"
    except OSError:
        return False


def running(session: int) -> list[str]:
    """Return the commands of a session's processes that are no zombies."""
    found = []
    for stat in Path("/proc").glob("[0-9]*/stat"):
        try:
            fields = state(stat)
            if int(fields[3]) == session and fields[0] != "Z":
                found.append((stat.parent / "cmdline").read_text().replace("\0", " "))
        except OSError:
            continue
    return found
