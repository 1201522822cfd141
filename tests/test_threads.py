"""Threads of the solver: every chunk once, errors told, forks survived."""

import multiprocessing
import os
import threading

import numpy as np
import pytest

from uwsfm.solver import threads


def test_every_chunk_runs_once_and_tasks_have_one_thread(monkeypatch):
    monkeypatch.setattr(threads, "_available", lambda: 3)
    done, names, inside = np.zeros(50, dtype=int), set(), set()
    meet = threading.Barrier(3, timeout=10.0)

    def task(chunk):
        if chunk < 3:
            meet.wait()  # passes only if three threads are at work
        done[chunk] += 1
        names.add(threading.current_thread().name)
        inside.add(threads.num_threads())

    threads.run_chunks(task, len(done))
    assert np.all(done == 1) and len(names) == 3 and inside == {1}
    with threads.limited(1):
        names.clear()
        threads.run_chunks(lambda _: names.add(threading.current_thread().name), 4)
    assert names == {threading.current_thread().name}
    assert threads.num_threads() == 3


def test_an_error_of_a_chunk_is_raised(monkeypatch):
    monkeypatch.setattr(threads, "_available", lambda: 2)

    def task(chunk):
        if chunk == 7:
            raise ValueError("seven")

    with pytest.raises(ValueError, match="seven"):
        threads.run_chunks(task, 16)


def test_the_number_of_threads_follows_the_environment(monkeypatch):
    monkeypatch.setenv("NUMBA_NUM_THREADS", "1")
    assert threads.num_threads() == 1
    monkeypatch.setenv("NUMBA_NUM_THREADS", "1000")
    assert 1 <= threads.num_threads() <= (os.cpu_count() or 1)


def _in_child(queue):
    total = np.zeros(8)

    def task(chunk):
        total[chunk] = 1.0

    threads.run_chunks(task, 8)
    queue.put(float(total.sum()))


@pytest.mark.skipif(not hasattr(os, "fork"), reason="no fork on this system")
@pytest.mark.filterwarnings("ignore:.*fork.*:DeprecationWarning")
def test_a_forked_process_has_threads_of_its_own(monkeypatch):
    monkeypatch.setattr(threads, "_available", lambda: 2)
    threads.run_chunks(lambda chunk: None, 8)  # the parent's threads exist
    context = multiprocessing.get_context("fork")
    queue = context.Queue()
    child = context.Process(target=_in_child, args=(queue,))
    child.start()
    try:
        assert queue.get(timeout=20.0) == 8.0
    finally:
        child.join(20.0)


def test_chunks_are_of_about_equal_work_and_cover_everything():
    start = np.concatenate([[0], np.cumsum([1, 1, 1, 9, 1, 1, 1, 1])])
    assert threads.chunk_bounds(start, 2).tolist() == [0, 4, 8]
    for num_chunks in (1, 3, 20):
        bounds = threads.chunk_bounds(start, num_chunks)
        assert len(bounds) == num_chunks + 1 and bounds[0] == 0 and bounds[-1] == 8
        assert np.all(np.diff(bounds) >= 0)
