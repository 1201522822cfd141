"""The table of port kinds: what one line in it gives, and what is in no table."""

import ast
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from jacobians import EXAMPLE_PORTS
from test_three_cameras import three_camera_rig

import uwsfm
from uwsfm import InputError
from uwsfm.models.ports.dispatch import kernels_of, scalar_nouns
from uwsfm.models.ports.port import (
    KINDS,
    DomePort,
    FlatPort,
    InterfacePort,
    NoPort,
    kind_of_word,
    port_from_row,
)
from uwsfm.models.ports.row import KIND
from uwsfm.results.schema import summary_schema
from uwsfm.rig.file import dump_rig, load_rig
from uwsfm.rig.rig import refine_flags
from uwsfm.sfm.from_colmap.refractive_colmap import (
    PortCamera,
    camera_line,
    read_refractive_cameras,
)
from uwsfm.simulate.sequence import _port_truth

PORTS = [p for p in EXAMPLE_PORTS.values() if p.n_air == 1.0 and p.n_glass >= p.n_water]
SOME = {kind: [p for p in PORTS if type(p) is kind][-1] for kind in KINDS}
"""A port of each kind that a rig file takes, with numbers that are not the defaults."""
kinds = pytest.mark.parametrize("kind", KINDS, ids=lambda kind: kind.word)


def test_no_two_kinds_have_the_same_word_or_code():
    assert len({kind.word for kind in KINDS}) == len(KINDS)
    assert len({kind.code for kind in KINDS}) == len(KINDS)


def rig_behind(port):
    rig = three_camera_rig()
    flags = refine_flags(port.refinable[:1])
    cameras = [replace(camera, port=port, **flags) for camera in rig.cameras]
    return replace(rig, cameras=tuple(cameras))


@kinds
def test_every_kind_goes_through_files_and_rows_unchanged(tmp_path, kind):
    """Rig file -> rig -> row -> port -> rig file."""
    first, second = tmp_path / "first.yaml", tmp_path / "second.yaml"
    dump_rig(rig_behind(SOME[kind]), first)
    rig = load_rig(first)
    assert all(type(camera.port) is kind for camera in rig.cameras)
    rows = [camera.port.row for camera in rig.cameras]
    ports = [port_from_row(row) for row in rows]
    assert ports == [camera.port for camera in rig.cameras]
    dump_rig(rig.with_geometry(rig.cam_from_rig, ports), second)
    assert second.read_text() == first.read_text()
    for camera in rig.cameras:
        for name in ("normal", "distance", "center"):
            expected = name in kind.refinable[:1]
            assert getattr(camera, f"refine_{name}") == expected


@kinds
def test_every_kind_comes_back_from_refractive_colmap_and_is_in_the_truth(
    tmp_path, kind
):
    camera = three_camera_rig().cameras[0].camera
    line = camera_line(1, PortCamera(camera=camera, port=SOME[kind]))
    path = tmp_path / "cameras.txt"
    path.write_text(line)
    assert read_refractive_cameras(path)[1].port == SOME[kind]
    truth = json.loads(json.dumps(_port_truth(SOME[kind])))
    assert truth["port"] == kind.word
    assert list(truth) == ["port", *SOME[kind].stated()] + kind.refracts * [
        "water_index"
    ]


@kinds
def test_a_step_of_a_place_is_undone_by_its_difference(kind, rng):
    place = SOME[kind].row[:4]
    step = 1e-3 * rng.normal(size=4)
    if kind is not DomePort:
        step[3] = 0.0  # no radius
    if kind is NoPort:
        step[:] = 0.0
    moved = kind.plus(place, step)
    np.testing.assert_allclose(kind.minus(place, moved), -step, atol=1e-12)


def test_the_schema_of_summaries_has_all_kinds():
    words = summary_schema()["$defs"]["camera"]["properties"]["port"]["enum"]
    assert words == [kind.word for kind in KINDS]


def test_an_unknown_kind_is_refused_in_one_sentence(tmp_path):
    row = FlatPort().row
    row[KIND] = 4.0
    with pytest.raises(InputError, match=r"4 is no kind of port .* 3 \(interface\)"):
        port_from_row(row)
    # The row of issue 18, of which a flat port was made without a word.
    wrong = [0, 0, 1, 0.02, 0.01, 1, 1.5, 1.33, 5.0]
    with pytest.raises(InputError, match="5 is no kind of port"):
        port_from_row(wrong)
    with pytest.raises(InputError, match="the row of a port has 9 numbers, got 8"):
        port_from_row(wrong[:8])
    with pytest.raises(InputError, match="flat, dome, none and interface"):
        kind_of_word("cube")
    camera = three_camera_rig().cameras[0].camera
    with pytest.raises(InputError, match="FlatPort, DomePort, NoPort, InterfacePort"):
        uwsfm.RefractiveCamera(camera, "flat")


def test_a_kind_without_vectorised_kernels_is_named():
    assert scalar_nouns([FlatPort(), DomePort(), NoPort()]) == []
    nouns = scalar_nouns([FlatPort(), InterfacePort(), InterfacePort()])
    assert nouns == [InterfacePort.noun]
    assert kernels_of(NoPort) is kernels_of(FlatPort)


# ---- Rows have names ----------------------------------------------------------------

PACKAGE = Path(uwsfm.__file__).parent
ROWS = {"port", "ports", "port_row", "lens", "lenses"}
"""What rows, and arrays of rows, of ports and lenses are called."""


def last_index(node):
    """The index of a subscript along the numbers of a row."""
    if isinstance(node.slice, ast.Tuple):
        return node.slice.elts[-1]
    return node.slice


def is_bare(index):
    """Whether an index is a number, or a slice with one."""
    if isinstance(index, ast.Slice):
        return any(is_bare(end) for end in (index.lower, index.upper) if end)
    if isinstance(index, ast.UnaryOp):
        return is_bare(index.operand)
    return isinstance(index, ast.Constant) and isinstance(index.value, int)


def bare_indices(tree, names):
    for node in ast.walk(tree):
        if isinstance(node, ast.Subscript) and is_bare(last_index(node)):
            of = node.value
            name = getattr(of, "attr", getattr(of, "id", ""))
            if name in names:
                yield ast.unparse(node)


def test_rows_of_ports_and_lenses_are_read_by_names():
    found = []
    for path in sorted(PACKAGE.rglob("*.py")):
        # In the models a "row" is that of a lens or a port, elsewhere of anything.
        names = ROWS | ({"row"} if "models" in path.parts else set())
        tree = ast.parse(path.read_text(encoding="utf-8"))
        found += [f"{path.name}: {text}" for text in bare_indices(tree, names)]
    assert found == []


def test_the_scan_sees_what_it_looks_for():
    tree = ast.parse("a = port[3]; b = state.ports[:, 3]; c = camera.lens[2:4]; e[0]")
    assert len(list(bare_indices(tree, ROWS))) == 3
    assert not list(bare_indices(ast.parse("port[KIND]; lenses[c]; ports[at]"), ROWS))
