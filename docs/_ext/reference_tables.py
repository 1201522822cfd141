"""Reference tables made from the program's own declarations when the manual is built.

A line `{{ options }}`, `{{ rig_file }}` ... in a page is replaced by its tables.
"""

from __future__ import annotations

import ast
import inspect
import re
import types
import typing
from collections.abc import Callable, Iterator
from typing import Any

from annotated_types import BaseMetadata
from command_tree import Command, commands
from pydantic import BaseModel
from pydantic.fields import FieldInfo
from pydantic_core import PydanticUndefined
from sphinx.application import Sphinx

import uwsfm
from uwsfm.calibration import given_accuracy
from uwsfm.calibration.parameter import Accuracy
from uwsfm.calibration.parameters import PARAMETERS
from uwsfm.inputs import lengths_file
from uwsfm.jobs import dives_file
from uwsfm.measuring import measurements_file
from uwsfm.rig import schema as rig_schema
from uwsfm.rig.values import ACCURACIES

PAGES_OF_API = {
    "Run a whole job": "reconstruct refine_model calibrate_housing run_batch "
    "check_halves dense_cloud ReconstructOptions RefineOptions CalibrateHousingOptions "
    "MatchOptions StartOptions",
    "Read a rig and a result": "load_rig Rig open_result Result read_model Model "
    "write_report",
    "Cameras and ports": "RefractiveCamera FlatPort DomePort InterfacePort NoPort "
    "Status",
    "Adjust arrays of your own": "Scene calibrate CalibrateOptions CalibrationResult "
    "Lengths Distances Positions perspective_adjustment",
    "Uncertainty and verdict": "predict_covariance error_budget with_budget verdicts "
    "judge Verdict",
    "Measure, clean, mesh, map, colour": "measure clean_cloud mesh_cloud make_map "
    "correct_colors Cloud read_cloud write_cloud",
    "Export and import": "export_colmap export_housing export_las export_pinhole "
    "export_ply export_refractive_colmap export_scene_ply read_refractive_colmap "
    "rig_of_refractive_colmap",
    "Errors": "UwsfmError InputError",
}


ORDER = (
    *("init", "demo", "reconstruct", "calibrate", "refine", "check", "view", "report"),
    *("measure", "dense", "clean", "mesh", "map", "color", "export", "batch"),
)
"""Of the commands on their page; others follow."""


def table(header: list[str], rows: list[list[str]], kind: str = "") -> str:
    """A table in Markdown; its kind is a class of manual.css."""

    def line(cells: list[str]) -> str:
        return "| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |"

    rule = line(["---"] * len(header))
    marks = [f"{{.{kind}}}"] if kind else []
    return "\n".join([*marks, line(header), rule, *map(line, rows)])


def options() -> str:
    """Every command with its arguments and options."""
    tree = dict(commands())
    general = tree.pop("")
    parts = ["## Before the command\n", _command_table(general)]
    names = [name for name in ORDER if name in tree]
    for name in dict.fromkeys([*names, *tree]):
        command = tree[name]
        arguments = [p for p in command.parameters if p.is_argument]
        usage = " ".join(
            f"<{p.names[0].lower()}>" if p.required else f"[{p.names[0].lower()}]"
            for p in arguments
        )
        parts += [
            f"## uwsfm {name}\n",
            f"{command.help}\n",
            f"```text\nuwsfm {name} {usage} [options]\n```\n",
            _command_table(command),
        ]
    return "\n".join(parts)


def _command_table(command: Command) -> str:
    rows = []
    for parameter in command.parameters:
        names = ", ".join(f"`{name}`" for name in parameter.names)
        kind = parameter.kind + (", may be repeated" if parameter.repeated else "")
        kind += ", **required**" if parameter.required else ""
        words = re.sub(r"(?<![\w`])(--[a-z][\w=-]*)", r"`\1`", parameter.help)
        rows.append([names, kind, parameter.default, words])
    header = ["name", "value", "default", "meaning"]
    return table(header, rows, "options") + "\n"


def rig_file() -> str:
    return "\n".join(_entries(rig_schema, ENTRY_TITLES))


ENTRY_TITLES = {
    "": "The whole file",
    "water": "water",
    "cameras": "cameras: one entry each",
    "(colmap)": "intrinsics: COLMAP's form",
    "opencv": "intrinsics, opencv",
    "radial_undistortion": "intrinsics, radial_undistortion",
    "(flat)": "port, type flat",
    "(dome)": "port, type dome",
    "cam_from_rig": "cam_from_rig",
    "accuracy": "accuracy of a camera",
    "(rig accuracy)": "accuracy of the rig",
    "(covariance)": "accuracy of the rig, covariance",
}


def _entries(module: types.ModuleType, titles: dict[str, str]) -> Iterator[str]:
    for key, entry in module.ENTRIES.items():
        title = titles.get(key) if titles else key or "The whole file"
        if title is not None:
            yield f"### {title}\n"
            yield _fields(entry)


def _fields(entry: type[BaseModel]) -> str:
    hints = typing.get_type_hints(entry, include_extras=True)
    rows = []
    for name, info in entry.model_fields.items():
        rows.append([f"`{name}`", _type_of(hints[name]), _default_of(info)])
    return table(["key", "value", "default"], rows) + "\n"


def _default_of(info: FieldInfo) -> str:
    if info.is_required():
        return "required"
    value = info.get_default(call_default_factory=True)
    if value is None or value is PydanticUndefined or isinstance(value, BaseModel):
        return ""
    if isinstance(value, tuple):
        return "" if not value else f"`{list(value)}`"
    return f"`{str(value).lower() if isinstance(value, bool) else value}`"


def _type_of(hint: Any) -> str:
    """The type of a key in words."""
    origin, args = typing.get_origin(hint), typing.get_args(hint)
    if origin is typing.Annotated:
        return _type_of(args[0]) + _bounds(args[1:])
    if origin in (typing.Union, types.UnionType):
        kinds = dict.fromkeys(_type_of(a) for a in args if a is not type(None))
        return " or ".join(kinds)
    if origin is typing.Literal:
        return ", ".join(f"`{value}`" for value in args)
    if origin is tuple:
        return "list of " + _type_of(args[0])
    if inspect.isclass(hint) and issubclass(hint, BaseModel):
        return "block"
    names = {float: "number", int: "whole number", bool: "`true`, `false`"}
    return names.get(hint, "text")


def _bounds(metadata: tuple[Any, ...]) -> str:
    limits: dict[str, Any] = {}
    for item in metadata:
        for bound in getattr(item, "metadata", [item]):
            if isinstance(bound, BaseMetadata):
                limits |= {k: getattr(bound, k) for k in _LIMITS if hasattr(bound, k)}
    least, most = limits.get("min_length"), limits.get("max_length")
    if least is not None and least == most:
        return f" (exactly {least})"
    words = [_LIMITS[key].format(f"{value:.7g}") for key, value in limits.items()]
    return f" ({', '.join(words)})" if words else ""


_LIMITS = {
    "gt": "above {}",
    "ge": "at least {}",
    "lt": "below {}",
    "le": "at most {}",
    "min_length": "{} or more",
    "max_length": "{} at most",
}


def accuracy_limits() -> str:
    rows = [[f"`{key}`", f"{most:g}", unit] for key, (most, unit) in ACCURACIES.items()]
    return table(["key", "must be below", "unit"], rows)


def accuracy_defaults() -> str:
    """The defaults of the parameters, and the module's constants with the sentence that
    stands below each."""
    declared = [each.accuracy for each in PARAMETERS if each.accuracy is not None]
    stated = [[f"`{own.key}`", _default_accuracy(own), own.because] for own in declared]
    return table(["default", "value", "reason"], stated + _constants(), "sentences")


def _default_accuracy(own: Accuracy) -> str:
    share = f"{own.share:g} of the value" if own.share else ""
    least = f"{own.least:g}" if own.least else ""
    return ", at least ".join(filter(None, [share, least]))


def _constants() -> list[list[str]]:
    body = ast.parse(inspect.getsource(given_accuracy)).body
    rows = []
    for node, after in zip(body, body[1:], strict=False):
        if not isinstance(node, ast.Assign) or not isinstance(after, ast.Expr):
            continue
        names = [
            name.id
            for target in node.targets
            for name in ast.walk(target)
            if isinstance(name, ast.Name) and name.id.isupper() and name.id[0] != "_"
        ]
        if not names:
            continue
        values = ", ".join(f"{getattr(given_accuracy, name):g}" for name in names)
        why = " ".join(ast.literal_eval(after.value).split())
        rows.append([", ".join(f"`{name}`" for name in names), values, why])
    return rows


def yaml_files() -> str:
    parts = []
    for title, module in (
        ("lengths.yaml", lengths_file),
        ("measurements.yaml", measurements_file),
        ("dives.yaml", dives_file),
    ):
        parts += [f"## {title}\n"]
        if hasattr(module, "ENTRIES"):
            parts += _entries(module, {})
        example = re.search(r"\n\n((?:    .*\n|\n)+)", f"{module.__doc__}\n")
        if example:
            text = inspect.cleandoc("\n" + example[1])
            parts += [f"```yaml\n{text}\n```\n"]
    return "\n".join(parts)


def api() -> str:
    """Every public name under one of the titles above."""
    listed = [name for names in PAGES_OF_API.values() for name in names.split()]
    missing = set(uwsfm.__all__) ^ set(listed)
    if missing:
        raise ValueError(f"PAGES_OF_API and uwsfm.__all__ differ: {sorted(missing)}")
    parts = []
    for title, names in PAGES_OF_API.items():
        parts += [f"## {title}\n", "```{eval-rst}"]
        for name in names.split():
            value = getattr(uwsfm, name)
            if not inspect.isclass(value):
                parts += [f".. autofunction:: uwsfm.{name}\n"]
                continue
            kind = "exception" if issubclass(value, Exception) else "class"
            parts += [f".. auto{kind}:: uwsfm.{name}", "   :members:\n"]
        parts += ["```\n"]
    return "\n".join(parts)


TABLES: dict[str, Callable[[], str]] = {
    function.__name__: function
    for function in (
        options,
        rig_file,
        accuracy_limits,
        accuracy_defaults,
        yaml_files,
        api,
    )
}


def fill(app: Sphinx, page: str, source: list[str]) -> None:
    source[0] = re.sub(
        r"^\{\{ (\w+) \}\}$", lambda m: TABLES[m[1]](), source[0], flags=re.MULTILINE
    )


def setup(app: Sphinx) -> dict[str, bool]:
    app.connect("source-read", fill)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
