"""The graph of the tests of nodes."""

import pytest
from ros_graph import graph_in


@pytest.fixture
def graph(tmp_path):
    """Yield a Graph and end its processes afterwards."""
    with graph_in(tmp_path) as graph:
        yield graph
