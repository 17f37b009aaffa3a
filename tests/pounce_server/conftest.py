"""A capture without a GPU, for both families' fast paths."""

from __future__ import annotations

import pytest

from dual_system.models.graphs import Work


class Recorder:
    """Runs work before the recording as a graph does, and lists what is captured (c) and replayed (r)."""

    def __init__(self) -> None:
        self.events = ""

    def __call__(self, work: Work) -> Work:
        self.events += "c"
        work()
        work()

        def replay() -> None:
            self.events += "r"
            work()

        return replay


@pytest.fixture
def recorder() -> Recorder:
    return Recorder()
