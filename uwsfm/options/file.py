"""options.yaml: the options of a job, written beside its result and read by --config.

Keys are those of Python and of dives.yaml. Paths are as given: relative ones are
relative to the working folder, as on the command line.
"""

from __future__ import annotations

import reprlib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from uwsfm._base.files import replaced_file
from uwsfm._base.options import Option, unknown
from uwsfm.errors import InputError
from uwsfm.options.jobs import JobOptions

OPTIONS = "options.yaml"


def write_options(options: JobOptions, path: Path) -> None:
    """Write all options of a job, those at their defaults included."""
    import yaml

    lines = ["# The options of this result; uwsfm reads them with --config."]
    for name, value in options.adjustment.further.items():
        plain = " ".join(str(value).split())
        lines.append(f"# Asked for in Python, and no option: {name} = {plain}")
    data = {item.name: _plain(value) for item, value in options.items()}
    text = yaml.safe_dump(data, sort_keys=False, allow_unicode=True)
    with replaced_file(path) as partial:
        partial.write_text("\n".join(lines) + "\n" + text, encoding="utf-8")


def read_typed(
    path: Path, options: Sequence[Option], extra: Sequence[str] = ()
) -> dict[str, str | list[str]]:
    """The options of a YAML file by name, each as it would be typed.

    So a value in a file is checked as one on the command line, and refused in the same
    words. A list has one text for each time that its flag would be given.

    Args:
        path: Of the file.
        options: Those that it may hold.
        extra: Further keys, whose values are single words.

    Raises:
        InputError: one sentence with the file and the key: no such file, not YAML, an
            unknown key, or a value that cannot be typed.
    """
    from uwsfm._base.yaml import read_yaml

    known: dict[str, Option | None] = dict.fromkeys(extra)
    known |= {item.name: item for item in options}
    try:
        data = read_yaml(path, "seed: 1")
    except InputError as error:
        raise InputError(f"{path}: {error}") from None
    found: dict[str, str | list[str]] = {}
    for key, value in data.items():
        if key not in known:
            meant = unknown(str(key), list(known))
            raise InputError(f"{path}: {key}: unknown key, {meant}")
        if value is None:
            continue
        try:
            found[key] = _typed(known[key], value)
        except ValueError as error:
            raise InputError(f"{path}: {key}: {error}") from None
    return found


def _typed(item: Option | None, value: Any) -> str | list[str]:
    shown = reprlib.repr(value)
    if item is not None and item.is_mapping:
        if not isinstance(value, Mapping):
            raise ValueError(f"must be a block of keys, not {shown}")
        return item.texts(value)
    if item is not None and (item.is_list or item.is_vector):
        if not isinstance(value, list):
            raise ValueError(f"must be a list, not {shown}")
        return item.texts(value) if item.is_list else item.texts(value)[0]
    if isinstance(value, (list, Mapping)):
        raise ValueError(f"must be one value, not {shown}")
    return str(value) if item is None else item.texts(value)[0]


def _plain(value: Any) -> Any:
    """As YAML takes it without tags."""
    if isinstance(value, Path):
        return str(value)
    if isinstance(value, tuple):
        return list(value)
    return dict(value) if isinstance(value, Mapping) else value
