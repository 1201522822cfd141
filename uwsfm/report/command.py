"""The command that makes a result again."""

import inspect
import shlex
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from uwsfm.calibration.problem import PRIORS

_REFINABLE = ("water_index", "focal", "principal_point", "distortion")
_NAMES = {"scene_distance_m": "scene_distance", "num_threads": "threads"}


def command_line(
    command: str, function: Callable[..., Any], asked: Mapping[str, Any]
) -> str | None:
    """A call of `reconstruct` or `refine_model` as the user would type it.

    Args:
        command: of ``uwsfm``.
        function: what was called; its parameters are the options of the command.
        asked: its arguments by name.

    Returns:
        None: the call has what no command takes, such as a rig that is no file.
    """
    words = ["uwsfm", command]
    for name, parameter in inspect.signature(function).parameters.items():
        value = asked[name]
        if name == "progress" or value is parameter.default:
            continue
        if parameter.kind is inspect.Parameter.VAR_KEYWORD:
            more = _calibration(value)
        elif parameter.default is inspect.Parameter.empty and name != "out":
            more = [str(value)] if isinstance(value, (str, Path)) else None
        else:
            more = _option(name, value, parameter.default)
        if more is None:
            return None
        words += more
    return shlex.join(words)


def _option(name: str, value: Any, default: Any) -> list[str] | None:
    flag = f"--{_NAMES.get(name, name).replace('_', '-')}"
    if isinstance(value, bool):
        if value == default:
            return []
        return [flag] if value else [flag.replace("--", "--no-", 1)]
    if isinstance(value, (str, Path, int, float)):
        return [] if value == default else [flag, str(value)]
    # A lever arm; joined by "=", as it may begin with a minus.
    return [f"{flag}={','.join(f'{float(number):.12g}' for number in value)}"]


def _calibration(options: Mapping[str, Any]) -> list[str] | None:
    """Fields of `CalibrateOptions`."""
    words = []
    for name, value in options.items():
        if name in PRIORS:
            if value is not None:
                words += ["--prior", f"{name}={value:.12g}"]
        elif name.removeprefix("refine_") in _REFINABLE and isinstance(value, bool):
            what = name.removeprefix("refine_").replace("_", "-")
            words += ["--refine", what] if value else []
        else:
            return None
    return words
