"""Processes that a test looks at from outside."""

from contextlib import suppress
from pathlib import Path


def children_of(pid):
    """Return the processes that a process has started, in any of its threads."""
    found = []
    for children in Path(f'/proc/{pid}/task').glob('*/children'):
        with suppress(FileNotFoundError):  # the thread may have ended
            found += map(int, children.read_text().split())
    return found
