"""Processes that are started import what their parent does, wherever they are."""

import subprocess
import sys
from pathlib import Path

import pytest

import uwsfm
from uwsfm._base.children import import_path, module_command
from uwsfm._base.tasks import Workers
from uwsfm.jobs import compile_kernels as first_run

PACKAGE = Path(uwsfm.__file__).resolve().parent
TRAP = "import os; os._exit(77)\n"


@pytest.fixture
def hostile(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A working folder that ends each process that imports from it: packages named as
    ours, and as what our children import first."""
    for name in ("uwsfm", "numpy", "runpy", "dask", "distributed", "multiprocessing"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "__init__.py").write_text(TRAP)
    monkeypatch.chdir(tmp_path)
    return tmp_path


def place(_: int) -> tuple[str, list[str]]:
    import sys

    import uwsfm

    return uwsfm.__file__, sys.path


def test_the_trap_closes(hostile):
    """Else the others would show nothing."""
    command = [sys.executable, "-m", "uwsfm.errors"]
    assert subprocess.run(command, check=False).returncode == 77


@pytest.mark.parametrize("entry", ["", ".", "HERE"])
def test_the_working_folder_is_not_on_the_path_of_a_child(hostile, monkeypatch, entry):
    """However the parent's own path names it."""
    entry = str(hostile) if entry == "HERE" else entry
    monkeypatch.setattr(sys, "path", [entry, *sys.path])
    assert str(hostile) not in import_path()
    assert all(Path(folder).is_absolute() for folder in import_path())
    subprocess.run(module_command("uwsfm.errors"), check=True)


def test_a_package_of_the_working_folder_is_its_childrens_too(monkeypatch):
    """As in a source tree where nothing is installed, by `python -c`."""
    monkeypatch.chdir(PACKAGE.parent)
    elsewhere = [p for p in sys.path if p and Path(p).resolve() != PACKAGE.parent]
    monkeypatch.setattr(sys, "path", ["", *elsewhere])
    assert import_path()[0] == str(PACKAGE.parent)


def test_compilers_are_those_of_the_parent(hostile):
    """A job that does not exist fails where the job is looked up."""
    process = first_run._start("no such job")
    _, errors = process.communicate(timeout=60)
    assert "KeyError: 'no such job'" in errors
    assert str(PACKAGE / "jobs/compile_kernels.py") in errors


@pytest.mark.skipif(sys.version_info < (3, 11), reason="Dask itself starts unsafely")
def test_workers_are_those_of_the_parent(hostile):
    with Workers(max_processes=2) as workers:
        workers.num_processes = 2  # on one core, too
        for file, path in workers.run(place, [(0,), (1,)], "places"):
            assert Path(file).parent == PACKAGE
            assert not {"", ".", str(hostile)} & set(path)


def test_no_process_is_started_in_another_way():
    for path in PACKAGE.rglob("*.py"):
        if path.name != "children.py":
            text = path.read_text(encoding="utf-8")
            assert "sys.executable" not in text, path
