"""Steps that are done once: what is on disk and still right is not made again."""

from __future__ import annotations

import dataclasses
import hashlib
import json
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from uwsfm._base.files import replaced_file
from uwsfm._base.partial import remove_stale
from uwsfm.sfm.frontend.background import damaged

FILE_NAME = "steps.json"
FORMAT = 1


def fingerprint(inputs: Any) -> str:
    """A short hash of anything JSON can hold, and of paths, arrays and dataclasses."""
    text = json.dumps(inputs, sort_keys=True, default=_as_json)
    return hashlib.sha256(text.encode()).hexdigest()[:16]


def _as_json(value: Any) -> Any:
    """Every number of an array, which as text has only the first and the last ones.

    Raises:
        TypeError: it is something else, of which a text might hide a change.
    """
    if isinstance(value, (np.ndarray, np.generic)):
        return value.tolist()
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return dataclasses.asdict(value)
    if isinstance(value, Path):
        return str(value)
    raise TypeError(f"no step may depend on {type(value).__name__}")


class Steps:
    """The record of a workspace: each step's inputs, and whether it was finished.

    Steps run in a fixed order, and each one's inputs hold the fingerprint of the step
    before. A step that runs again makes those after it run again. The record is written
    before and after a step, whole or not at all: a process killed at any point leaves
    a workspace from which the next one goes on.

    Args:
        work_dir: The workspace; created if missing.
    """

    def __init__(self, work_dir: Path) -> None:
        self.work_dir = work_dir
        work_dir.mkdir(parents=True, exist_ok=True)
        remove_stale(work_dir, deep=True)
        self._path = work_dir / FILE_NAME
        self._records: dict[str, dict[str, Any]] = {}
        self._ran: set[str] = set()
        try:
            content = json.loads(self._path.read_text(encoding="utf-8"))
        except (OSError, ValueError):  # none yet, or not ours: all steps run
            return
        if isinstance(content, dict) and content.get("format") == FORMAT:
            self._records = content["steps"]

    def run(
        self,
        name: str,
        inputs: Any,
        action: Callable[[], None],
        *,
        outputs: Sequence[Path],
        clear: Callable[[], None] | None = None,
    ) -> str:
        """Run a step unless it is done, and return its fingerprint.

        Args:
            name: Of the step.
            inputs: All its result depends on, JSON.
            action: Does it. If a run with the same inputs was interrupted, what that
                left is still there, to continue from.
            outputs: Files and folders that it makes.
            clear: Removes what a run with other inputs left.

        Raises:
            UwsfmError: a file that a finished step made is empty.
        """
        key = fingerprint(inputs)
        record = self._records.get(name, {})
        same = record.get("fingerprint") == key
        done = same and record.get("finished", False)
        if done and all(path.exists() for path in outputs):
            for path in outputs:
                # SQLite would take it for a new database.
                if path.is_file() and path.stat().st_size == 0:
                    raise damaged(path)
            return key
        if clear is not None and (done or not same):
            clear()
        names = list(self._records)
        later = names[names.index(name) :] if name in names else []
        for stale in later:
            del self._records[stale]
        self._records[name] = {"fingerprint": key, "finished": False}
        self._write()
        start = time.monotonic()
        action()
        seconds = time.monotonic() - start
        self._ran.add(name)
        self._records[name].update(finished=True, seconds=round(seconds, 3))
        self._write()
        return key

    def seconds(self) -> dict[str, float]:
        """How long each finished step took, when it ran."""
        return {
            name: record["seconds"]
            for name, record in self._records.items()
            if record["finished"]
        }

    def of_earlier_runs(self) -> list[str]:
        """Finished steps that were not run again."""
        return [name for name in self.seconds() if name not in self._ran]

    def _write(self) -> None:
        content = {"format": FORMAT, "steps": self._records}
        with replaced_file(self._path) as partial:
            partial.write_text(json.dumps(content, indent=1), encoding="utf-8")
