"""Finished steps are skipped, interrupted ones go on, changed ones start again."""

import json
from types import SimpleNamespace

import pytest

from uwsfm._base.partial import PARTIAL
from uwsfm.errors import UwsfmError
from uwsfm.sfm import steps as module
from uwsfm.sfm.frontend.background import remove_database
from uwsfm.sfm.options import StartOptions
from uwsfm.sfm.steps import Steps, fingerprint


class Recorder:
    """A chain of two steps that counts what is done."""

    def __init__(self, work_dir):
        self.work_dir = work_dir
        self.done: list[str] = []

    def run(self, first="a", second="b", fails=""):
        steps = Steps(self.work_dir)
        key = steps.run(
            "first",
            first,
            lambda: self.act("first", fails),
            outputs=[self.work_dir / "first"],
            clear=lambda: self.done.append("clear first"),
        )
        steps.run(
            "second",
            [key, second],
            lambda: self.act("second", fails),
            outputs=[self.work_dir / "second"],
        )
        return steps

    def act(self, name, fails):
        self.done.append(name)
        if fails == name:
            raise KeyboardInterrupt
        (self.work_dir / name).write_text(name)

    def take(self):
        done, self.done = self.done, []
        return done


@pytest.fixture
def chain(tmp_path):
    chain = Recorder(tmp_path / "work")
    chain.run()
    assert chain.take() == ["clear first", "first", "second"]
    return chain


def test_finished_steps_are_skipped(chain):
    steps = chain.run()
    assert chain.take() == []
    assert set(steps.seconds()) == {"first", "second"}


def test_times_are_of_finished_steps_and_of_the_run_that_took_them(chain):
    steps = chain.run(second="c")
    assert steps.of_earlier_runs() == ["first"]
    with pytest.raises(KeyboardInterrupt):
        chain.run(first="d", fails="first")
    steps = Steps(chain.work_dir)
    assert steps.seconds() == {} and steps.of_earlier_runs() == []


def test_changed_inputs_restart_from_their_step(chain):
    chain.run(second="c")
    assert chain.take() == ["second"]
    chain.run(first="c", second="c")
    assert chain.take() == ["clear first", "first", "second"]


def test_inputs_that_come_back_are_not_taken_for_done(chain):
    chain.run(first="c")
    chain.take()
    chain.run(first="a")
    assert chain.take() == ["clear first", "first", "second"]


def test_an_interrupted_step_goes_on_from_what_it_left(chain):
    with pytest.raises(KeyboardInterrupt):
        chain.run(first="c", fails="first")
    chain.take()
    chain.run(first="c")
    assert chain.take() == ["first", "second"]  # nothing was cleared


def test_an_interrupted_step_starts_again_when_its_inputs_change(chain):
    with pytest.raises(KeyboardInterrupt):
        chain.run(first="c", fails="first")
    chain.take()
    chain.run(first="d")
    assert chain.take() == ["clear first", "first", "second"]


def test_missing_outputs_are_made_again_with_all_that_follows(chain):
    (chain.work_dir / "first").unlink()
    chain.run()
    assert chain.take() == ["clear first", "first", "second"]


def test_an_emptied_output_is_damaged_not_a_new_database(chain):
    (chain.work_dir / "first").write_text("")
    with pytest.raises(UwsfmError, match="first is damaged: remove the folder"):
        chain.run()
    assert chain.take() == []


@pytest.mark.parametrize("content", ["", "{", "[]", '{"format": 0}'])
def test_a_record_that_cannot_be_read_means_that_nothing_is_done(chain, content):
    (chain.work_dir / "steps.json").write_text(content)
    chain.run()
    assert chain.take() == ["clear first", "first", "second"]


def test_a_record_that_does_not_say_that_it_ended_is_of_no_finished_step(chain):
    path = chain.work_dir / "steps.json"
    content = json.loads(path.read_text())
    del content["steps"]["first"]["finished"]
    path.write_text(json.dumps(content))
    chain.run()
    assert chain.take() == ["first", "second"]


def test_half_written_outputs_of_a_killed_run_are_removed(chain):
    (chain.work_dir / f"{PARTIAL}x1.db").write_text("half")
    (chain.work_dir / f"{PARTIAL}x2").mkdir()
    (chain.work_dir / "colors").mkdir()
    (chain.work_dir / "colors" / f"{PARTIAL}x3.npy").write_text("half")
    (chain.work_dir / ".mine").write_text("somebody else's")
    chain.run()
    assert [path.name for path in chain.work_dir.rglob(".*")] == [".mine"]


def test_a_database_is_removed_with_its_journals(tmp_path):
    for name in ("a.db", "a.db-wal", "a.db-shm", "b.db"):
        (tmp_path / name).write_text("x")
    remove_database(tmp_path / "a.db")
    assert [path.name for path in tmp_path.iterdir()] == ["b.db"]


def test_seconds_are_those_between_start_and_end_to_a_thousandth(tmp_path, monkeypatch):
    times = iter([1000.0, 1002.34567, 5000.0, 5000.0004])
    monkeypatch.setattr(module, "time", SimpleNamespace(monotonic=lambda: next(times)))
    steps = Recorder(tmp_path).run()
    assert steps.seconds() == {"first": 2.346, "second": 0.0}
    assert Steps(tmp_path).seconds() == {"first": 2.346, "second": 0.0}
    record = json.loads((tmp_path / "steps.json").read_text())["steps"]
    assert [row["finished"] for row in record.values()] == [True, True]
    assert [row["fingerprint"] for row in record.values()] == [
        fingerprint("a"),
        fingerprint([fingerprint("a"), "b"]),
    ]


def test_a_step_that_lost_one_of_its_outputs_is_done_again(tmp_path):
    names, done = ("one", "two", "three"), []

    def run():
        outputs = [tmp_path / "work" / name for name in names]

        def act():
            done.append("act")
            for path in outputs:
                path.write_text("x")

        clear = done.append
        Steps(tmp_path / "work").run(
            "only", 1, act, outputs=outputs, clear=lambda: clear("clear")
        )
        assert all(path.exists() for path in outputs)

    run()
    for name in names:
        run()
        assert done == ["clear", "act"]  # the second time there is all of them
        (tmp_path / "work" / name).unlink()
        done.clear()
        run()
        assert done == ["clear", "act"]
    for name in names:
        (tmp_path / "work" / name).write_text("")
        with pytest.raises(UwsfmError, match=f"{name} is damaged: remove the folder"):
            run()
        (tmp_path / "work" / name).write_text("x")


def test_a_folder_that_a_step_made_may_have_no_size(tmp_path):
    """As folders have on some file systems, whatever is in them."""
    folder = SimpleNamespace(
        exists=lambda: True,
        is_file=lambda: False,
        stat=lambda: SimpleNamespace(st_size=0),
    )
    done = []
    for _ in range(2):
        Steps(tmp_path).run("only", 1, lambda: done.append("act"), outputs=[folder])
    assert done == ["act"]


def test_a_workspace_is_made_with_the_folders_above_it(tmp_path):
    steps = Steps(tmp_path / "one" / "two")
    assert steps.work_dir.is_dir() and steps.seconds() == {}


def test_a_class_is_nothing_that_a_step_may_depend_on():
    assert fingerprint(StartOptions()) == fingerprint([StartOptions()][0])
    assert fingerprint(StartOptions()) != fingerprint(StartOptions(seed=5))
    with pytest.raises(TypeError, match="^no step may depend on type$"):
        fingerprint(StartOptions)
