"""Fixtures shared by all tests."""

from types import ModuleType
from zlib import crc32

import numpy as np
import pytest
from result_folders import DiveResult, refined_dive

from uwsfm.errors import MissingPackageError
from uwsfm.jobs.compile_kernels import compile_kernels


def pytest_sessionstart(session: pytest.Session) -> None:
    """Compile what reconstructions need before the workers start: each would do so."""
    workers = session.config.getoption("numprocesses", default=None)
    if workers and not hasattr(session.config, "workerinput"):
        compile_kernels(2)


@pytest.fixture
def rng(request: pytest.FixtureRequest) -> np.random.Generator:
    """Random numbers that depend on the test's name alone, not on the order run."""
    return np.random.default_rng(crc32(request.node.name.encode()))


@pytest.fixture(scope="session")
def open3d() -> ModuleType:
    """Open3D; where it cannot be imported, the test is skipped with the reason."""
    from uwsfm._base.packages import import_package

    try:
        return import_package("open3d", "this test", "render")
    except MissingPackageError as error:
        pytest.skip(str(error))


@pytest.fixture(scope="session")
def dive_result(tmp_path_factory: pytest.TempPathFactory) -> DiveResult:
    """A simulated dive with a clicked scale bar, refined; tests must not change it."""
    return refined_dive(tmp_path_factory.mktemp("dive"))
