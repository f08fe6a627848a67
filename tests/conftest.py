"""Every test runs with the shapes of workbench checked (jaxtyping + beartype), on one thread a process."""

import logging
import os

# Before torch and numpy: two xdist workers share two cores, so each gets one thread.
for variable in ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS", "NUMBA_NUM_THREADS"):
    os.environ[variable] = "1"
# Child processes that a test starts must find this checkout's cache nowhere near the user's.
os.environ.setdefault("VTK_DEFAULT_OPENGL_WINDOW", "vtkEGLRenderWindow")

from jaxtyping import install_import_hook

# Warp's kernels are no Python functions: imported unchecked
import workbench.collisions.limb_kernels
import workbench.collisions.network_kernels
import workbench.collisions.posing_kernels
import workbench.geometry.warp_kernels  # noqa: F401  imported for the hook below

install_import_hook(["workbench", "widgets"], "beartype.beartype")

import numpy as np
import pytest


@pytest.fixture(autouse=True, scope="session")
def single_thread():
    import torch

    torch.set_num_threads(1)


@pytest.fixture(autouse=True)
def private_cache(tmp_path, monkeypatch):
    """No test reads or fills the user's cache."""
    monkeypatch.setenv("WORKBENCH_CACHE", str(tmp_path / "cache"))


@pytest.fixture(autouse=True)
def own_logging():
    """The commands set up logging onto the output of their test; it ends with the test."""
    root = logging.getLogger()
    handlers, level = list(root.handlers), root.level
    yield
    root.handlers[:] = handlers
    root.setLevel(level)


@pytest.fixture(scope="session")
def body():
    """The default body, read once a process."""
    from workbench.body.model import Body

    return Body.default()


@pytest.fixture
def rng():
    return np.random.default_rng(7)
