"""The ways of the force layer to the core, and its threads."""

from __future__ import annotations

from contextlib import nullcontext

import pytest
import torch
from layer_problems import Passing


@pytest.fixture(params=["in place", "operators"])
def way(request):
    """The way of the inputs to the core."""
    with Passing() if request.param == "operators" else nullcontext():
        yield


@pytest.fixture
def one_thread():
    """One thread of torch."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(threads)
